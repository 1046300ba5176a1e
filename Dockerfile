# The versions of the lock, built without a network:
#   pip download --requirement requirements.lock --dest wheels    # with Python 3.11 on Linux
#   docker build --network none --tag learnnorm .
#   docker run --rm --volume $PWD:/work learnnorm estimate left.jpg right.jpg
FROM python:3.11-slim
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir --no-index --find-links wheels --requirement requirements.lock \
    && pip install --no-cache-dir --no-deps --no-build-isolation .
WORKDIR /work
ENTRYPOINT ["learnnorm"]

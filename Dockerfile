# Both commands of the README in a container:
#
#     docker build -t rts .
#     docker run --rm -v "$PWD/out:/rts/out" rts             # make demo: pictures in out/
#     docker run --rm rts make test
FROM python:3.11-slim-bookworm
# What tests need of the system, as in the Makefile.
RUN apt-get update -qq \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        make git python3-venv libegl1 libgl1-mesa-dri libosd-dev g++ chromium \
    && rm -rf /var/lib/apt/lists/*
# Torch without CUDA.
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu PIP_NO_CACHE_DIR=1
WORKDIR /rts
COPY . .
RUN make .venv/.test
CMD ["make", "demo"]

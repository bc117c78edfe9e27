# An image whose containers run a campaign:
#     docker build -t groundwalk .
#     docker run --rm --user $(id -u):$(id -g) -v "$PWD":/work groundwalk campaign scenes.csv
# The folder with scenes.csv is /work, and data/ appears in it. With GPUs: `docker run --gpus all`.
# Built by buildah, without Docker, with Debian's Python 3.11 in place of the first image: 8.5 GB, 4.6 of them PyTorch for
# CUDA. A campaign of two scenes, one of which isn't there, was run in it by a user that isn't root.
FROM python:3.11-slim-bookworm

# Open3D, which simulates, links the first ones; Snakemake's storage plugin copies with rsync.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1 libgomp1 libidn2-0 libudev1 libx11-6 rsync \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/groundwalk
COPY . .
RUN pip install --no-cache-dir --disable-pip-version-check -c constraints.txt '.[campaign]' \
    snakemake-executor-plugin-kubernetes==0.5.1 snakemake-storage-plugin-fs==1.1.3

# Caches of numba and Snakemake: a user that isn't root has no home here.
ENV HOME=/tmp NUMBA_CACHE_DIR=/tmp/numba XDG_CACHE_HOME=/tmp/cache
WORKDIR /work
ENTRYPOINT ["groundwalk"]
CMD ["--help"]

# The benchmark in a container, on a CPU:  docker build -t libero-lifelong .
# For an NVIDIA GPU, with the index of the CUDA build of torch that the driver takes:
#   docker build -t libero-lifelong --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 .
#   docker run --rm --gpus all -v "$PWD/libero:/data" libero-lifelong train algo=er
FROM python:3.11-slim-bookworm

# extras of the package, see docs/install.md
ARG EXTRAS=train,judge,servers
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

# EGL and OSMesa, drawn in software where there is no GPU. Security updates of a pinned image need other versions than today's
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libopengl0 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/* \
    && mkdir -p /usr/share/glvnd/egl_vendor.d \
    && echo '{"file_format_version": "1.0.0", "ICD": {"library_path": "libEGL_nvidia.so.0"}}' \
        > /usr/share/glvnd/egl_vendor.d/10_nvidia.json

ENV PATH=/opt/libero/bin:$PATH \
    PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility

# the packages first: they stay where only the code changes
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY libero/__init__.py libero/
COPY libero_env/__init__.py libero_env/__init__.pyi libero_env/
COPY libero_eval/__init__.py libero_eval/
COPY lifelong/__init__.py lifelong/
COPY configs configs/
RUN python3 -m venv /opt/libero \
    && pip install --extra-index-url "$TORCH_INDEX" --constraint constraints.txt ".[$EXTRAS]" \
    && pip uninstall --yes libero-lifelong \
    && pip install --constraint constraints.txt --no-deps robosuite

COPY . .
RUN pip install --no-deps .

# what is made goes into /data: runs, and in the cache demonstrations; mount a folder there to keep it
RUN useradd --create-home --uid 1000 libero && mkdir /data && chown libero /data
USER 1000
WORKDIR /data
ENV LIBERO_CACHE=/data/cache \
    NUMBA_CACHE_DIR=/data/cache/numba

ENTRYPOINT ["libero"]
CMD ["doctor"]

# STAR on an NVIDIA GPU: the host needs a driver (580 or newer) and the NVIDIA container toolkit.
#
#   docker build -t star .
#   docker run --gpus all -v "$PWD/runs:/star/runs" star train ant_maze
FROM python:3.12-slim

# Pictures and films are drawn with EGL or OSMesa; .mp4 needs ffmpeg.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ffmpeg libegl1 libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /star
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY star star
COPY envs envs
COPY configs configs
COPY results/agents results/agents
RUN python -m pip install --no-cache-dir --constraint constraints.txt '.[cuda,warp]'

ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics \
    JAX_COMPILATION_CACHE_DIR=/star/runs/.jax
ENTRYPOINT ["star"]
CMD ["--help"]

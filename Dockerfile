# SPDX-License-Identifier: MIT
# docker build -t scapo .   then   docker run -it scapo   or   docker run scapo make demo
# Debian 13: its Python 3.13 and its Mesa, whose Vulkan device of the CPU SAPIEN takes.
FROM debian:trixie-slim
# gcc and g++ for torch.compile (with Python's headers), git for the tests; setup.sh adds Mesa's Vulkan driver by itself.
RUN apt-get update \
    && apt-get install -y --no-install-recommends make gcc g++ git python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /scapo
COPY . .
# An index with CPU builds of torch keeps CUDA's libraries out: --build-arg PIP_EXTRA_INDEX_URL=...
ARG PIP_EXTRA_INDEX_URL=""
RUN make setup && rm -rf /root/.cache
ENV PATH="/scapo/.venv/bin:$PATH"
CMD ["bash"]

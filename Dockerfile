# SPDX-License-Identifier: MIT
# docker build -t scapo .   then   docker run -it scapo   or   docker run scapo make demo
# Its lines were read against what scripts/setup.sh needs, but the image has not been built.
FROM python:3.12-slim-bookworm
# gcc and g++ for torch.compile, git for the tests; setup.sh adds Mesa's Vulkan driver by itself.
RUN apt-get update && apt-get install -y --no-install-recommends make gcc g++ git && rm -rf /var/lib/apt/lists/*
WORKDIR /scapo
COPY . .
RUN make setup
ENV PATH="/scapo/.venv/bin:$PATH"
CMD ["bash"]

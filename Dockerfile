# SPDX-License-Identifier: MIT
FROM python:3.12-slim-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends make gcc g++ git && rm -rf /var/lib/apt/lists/*
WORKDIR /scapo
COPY . .
RUN make setup
ENV PATH="/scapo/.venv/bin:$PATH"
ENTRYPOINT ["bash"]

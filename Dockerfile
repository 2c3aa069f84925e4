# docker build -t toftrack . && docker run --rm -v "$PWD:/data" toftrack track FILE hydra.run.dir=run
FROM python:3.12-slim
# Where pip finds a CPU build of torch (pytorch.org says it); else torch brings CUDA, several GB.
ARG PIP_EXTRA_INDEX_URL
COPY pyproject.toml README.md LICENSE /src/
COPY toftrack /src/toftrack
COPY conf /src/conf
RUN pip install --no-cache-dir '/src[figures,export]' && rm -r /src
WORKDIR /data
# A first run compiles kernels: now, and they stay in the image, for processors like this one's.
RUN toftrack track device.stop=2 hydra.run.dir=try && rm -r try
ENTRYPOINT ["toftrack"]

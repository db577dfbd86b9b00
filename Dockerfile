# segslam and the libraries that Open3D's wheel loads. Usage: docs/install.md
FROM python:3.12-slim
RUN apt-get update -qq \
    && apt-get install -y -qq --no-install-recommends libusb-1.0-0 libgl1 libegl1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*
COPY pyproject.toml README.md LICENSE /src/
COPY segslam /src/segslam
RUN pip install --no-cache-dir "/src[recordings,las]" && rm -rf /src && segslam warm-up
WORKDIR /data
ENTRYPOINT ["segslam"]

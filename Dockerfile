# The HTTP server in a container; the model is mounted, not built in.
#   docker build -t lightning-pose .
#   docker run --rm -p 127.0.0.1:8000:8000 -v "$PWD/best.ckpt:/model/best.ckpt:ro" lightning-pose /model/best.ckpt
FROM python:3.12-slim

# CPU builds of torch and torchvision: those of the default index bring gigabytes of CUDA.
RUN pip install --no-cache-dir torch torchvision --index-url https://download.pytorch.org/whl/cpu

WORKDIR /app
COPY pyproject.toml README.md LICENSE ./
COPY lightning_pose lightning_pose
RUN pip install --no-cache-dir ".[serve]"

RUN useradd --create-home server
USER server
WORKDIR /home/server
ENV OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1
EXPOSE 8000
HEALTHCHECK --start-period=60s CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/health', timeout=5)"]
ENTRYPOINT ["python", "-m", "lightning_pose", "serve", "--host", "0.0.0.0"]
CMD ["--help"]

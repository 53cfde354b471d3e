# The service as an image; see deploy/README.md for how to build and run it.

FROM python:3.11.14-slim-bookworm AS build
# An index that offers torch without CUDA; empty: whatever pip's own index offers.
ARG TORCH_INDEX_URL=""
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
WORKDIR /src

# Dependencies first: this layer stays while only the code changes.
COPY pyproject.toml constraints.txt ./
RUN python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
print(*p["dependencies"], *p["optional-dependencies"]["service"], sep="\n")' > requirements.txt \
    && pip install --constraint constraints.txt ${TORCH_INDEX_URL:+--extra-index-url "$TORCH_INDEX_URL"} \
        --requirement requirements.txt

COPY README.md LICENSE hatch_build.py ./
COPY model ./model
COPY service ./service
COPY clients ./clients
COPY protos ./protos
RUN python -m venv /opt/build \
    && /opt/build/bin/pip install --constraint constraints.txt hatchling \
        $(/opt/build/bin/python model/trajectron_model/kernels/build.py --requirement) \
    && /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir dist . \
    && pip install --no-deps dist/*.whl


FROM python:3.11.14-slim-bookworm
RUN useradd --system --uid 10001 --no-create-home trajectron \
    && install --directory --owner trajectron /var/lib/trajectron
COPY --from=build /opt/venv /opt/venv
# 0.0.0.0 on purpose: inside a container the loopback address is out of reach. Publish the
# ports where they are wanted, as deploy/compose.yaml does. INSECURE says that the service need not
# protect itself: it is plain text and open to whoever reaches its ports. To publish them further
# than loopback, set it to 0 and give it certificates and tokens: docs/security.md.
ENV PATH=/opt/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    MPLCONFIGDIR=/tmp/matplotlib \
    TRAJECTRON_HOST=0.0.0.0 \
    TRAJECTRON_INSECURE=1 \
    TRAJECTRON_HTTP_PORT=8000 \
    TRAJECTRON_GRPC_PORT=50051 \
    TRAJECTRON_STATE_DIR=/var/lib/trajectron \
    TRAJECTRON_LOG_FORMAT=json
USER 10001
EXPOSE 8000 50051
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as r; r.urlopen('http://127.0.0.1:' + os.environ['TRAJECTRON_HTTP_PORT'] + '/readyz', timeout=2)"]
ENTRYPOINT ["trajectron"]
CMD ["serve"]

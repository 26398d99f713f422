# docker build -t fracsim .
# docker run --rm --init -v "$PWD:/work" --user "$(id -u):$(id -g)" fracsim run study.toml
# docker run --rm --init -v "$PWD:/work" --user "$(id -u):$(id -g)" --shm-size 1g --entrypoint mpirun fracsim \
#     -n 2 fracsim run study.toml
#
# `system` holds the packages only: ./env runs a checkout in it.
FROM debian:trixie-slim AS system
COPY packages.txt /tmp/packages.txt
RUN apt-get update \
    && sed 's/#.*//' /tmp/packages.txt | DEBIAN_FRONTEND=noninteractive xargs apt-get install --yes --no-install-recommends \
    && rm -rf /var/lib/apt/lists/* /tmp/packages.txt
# As in ./env: a thread a rank, shared memory only, idle ranks yield.
ENV LANG=C.UTF-8 \
    OMP_NUM_THREADS=1 \
    OMPI_ALLOW_RUN_AS_ROOT=1 \
    OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 \
    OMPI_MCA_btl=self,sm \
    OMPI_MCA_mpi_yield_when_idle=1

FROM system AS build
COPY . /src
RUN python3 -m venv --system-site-packages --without-pip /opt/fracsim \
    && python3 -m pip --python /opt/fracsim/bin/python install --no-cache-dir --no-deps --requirement /src/wheels.txt --requirement /src/files.txt \
    && python3 -m pip --python /opt/fracsim/bin/python install --no-cache-dir --no-index --no-deps --no-build-isolation /src

FROM system
LABEL org.opencontainers.image.title="fracsim" \
      org.opencontainers.image.description="Fracture on the edges of a finite element mesh: FEniCSx, implicit, parallel" \
      org.opencontainers.image.licenses="MIT" \
      org.opencontainers.image.base.name="docker.io/library/debian:trixie-slim"
# Any user id may run it (--user): the home folder, which holds the compiled kernels, is everyone's, as /tmp is.
RUN useradd --create-home fracsim && mkdir /work && chown fracsim: /work && chmod 1777 /home/fracsim /work
COPY --from=build /opt/fracsim /opt/fracsim
ENV PATH=/opt/fracsim/bin:$PATH HOME=/home/fracsim
USER fracsim
WORKDIR /work
ENTRYPOINT ["fracsim"]
CMD ["--help"]

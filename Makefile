# `make demo` and `make test` set up all they need. `make check` does all that continuous integration does.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Each takes up to 5 GB, most of it compiled jax programs.
WORKERS ?= 2
# A worker takes tests that follow each other, and half of the other's last ones when it has none left.
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal
INSTALL := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet -c constraints.txt
SOURCES := pyproject.toml constraints.txt
EXAMPLE := tests/plugin_example
APPS := $(patsubst %/pyproject.toml,%,$(wildcard apps/*/pyproject.toml))
LOOPS := $(shell grep -rl --include=*.py -E '@loop|numba' rts rts_backends rts_surfaces)

# What opens the pages of comparisons, where no other browser that the tests know is there.
BROWSER := $(if $(shell command -v chromium || command -v chromium-browser || command -v google-chrome),,chromium)
# What tests need of the system, by Debian's names; installed where this is root or may use sudo.
SYSTEM_PACKAGES := python3-venv libegl1 libgl1-mesa-dri libosd-dev g++ $(BROWSER)
SUDO := $(shell if [ "$$(id -u)" = 0 ]; then echo env; elif sudo -n true 2>/dev/null; then echo sudo; fi)

.PHONY: check demo docs paper test test-all test-xla apps warmup lint types wheel oldest newest clean system

check: lint types docs test test-all test-xla apps wheel oldest

demo: $(VENV)/.demo
	$(BIN)/rts demo -o out

# NumPy, torch, every plugin through its kit, and one file of jax.
test: warmup
	$(PYTEST) -m "not thorough"

# The rest: jax, builds, other processes, and many examples of each property.
test-all: warmup
	$(PYTEST) -m "thorough or hypothesis" --hypothesis-profile many

# jax as users have it: XLA improves programs, which elsewhere in the tests would take longer than it saves.
test-xla: warmup
	XLA_FLAGS= $(PYTEST) tests/backends/test_jax.py

# Distributions of their own that are built on the library, each with its tests.
apps: warmup $(VENV)/.apps
	@for app in $(APPS); do echo "== $$app"; $(PYTEST) $$app/tests || exit 1; done

# The site, in build/site: tutorials are executed, and every warning and every dead link is an error. RTS_QUICK=1 makes
# the pictures of tutorials small. Tutorials write pictures into the folder that they run in.
docs: export JUPYTER_CONFIG_DIR := $(CURDIR)/build/pictures
docs: export NO_MKDOCS_2_WARNING := 1
docs: warmup $(VENV)/.docs
	mkdir -p build/pictures
	echo '{"KernelManager": {"transport": "ipc"}}' > build/pictures/jupyter_nbconvert_config.json
	cd build/pictures && $(abspath $(BIN))/mkdocs build --strict -f $(CURDIR)/mkdocs.yml

# Every figure and table of the paper, small, into out/paper; and the page of them, from the results of full size.
paper: warmup
	$(BIN)/python -m benchmarks.paper all --quick
	$(BIN)/python -m benchmarks.pages

# Loops that both workers need are compiled once, ahead; where that fails, the tests say more.
warmup: system $(VENV)/.test $(VENV)/.warm

$(VENV)/.warm: $(VENV)/.test $(LOOPS)
	-$(BIN)/rts warmup && touch $@

# Ruff: rules and format of Python, in Markdown too.
lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.apps $(VENV)/.dev
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright --pythonpath $(BIN)/python

# Build and check the distributions, and the applications; then, elsewhere and from wheels alone, the demo, the tests of
# the example plugin, and a folder of COLMAP made a mesh.
wheel: $(VENV)/.dev
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl
	for app in $(APPS); do $(BIN)/python -m build --wheel --outdir dist $$app || exit 1; done
	PYTHON=$(PYTHON) tests/wheel.sh dist $(EXAMPLE) constraints.txt
	PYTHON=$(PYTHON) apps/wheels.sh dist constraints.txt

# Sets of versions, and the tests that would notice. TORCH=2.13.0 takes that torch in place of the set's.
oldest newest: system
	PYTHON=$(PYTHON) WORKERS=$(WORKERS) tests/versions.sh $@

system:
	@missing=$$(for p in $(SYSTEM_PACKAGES); do dpkg -s $$p >/dev/null 2>&1 || echo $$p; done); \
	if ! command -v dpkg >/dev/null; then \
		echo "not a Debian system: install the equivalents of $(SYSTEM_PACKAGES) if tests are skipped"; \
	elif [ -n "$$missing" ] && [ -n "$(SUDO)" ]; then \
		$(SUDO) apt-get update -qq; \
		for p in $$missing; do \
			$(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$p >/dev/null \
				|| echo "could not install $$p: tests that need it are skipped"; \
		done; \
	elif [ -n "$$missing" ]; then \
		echo "not root and no sudo: tests that need these Debian packages are skipped: $$missing"; \
	fi

%/bin/python:
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || $(MAKE) system
	$(PYTHON) -m venv $*
	$@ -m pip install --quiet --upgrade pip

$(VENV)/.demo: $(BIN)/python $(SOURCES)
	$(INSTALL) -e '.[torch,plots,cli]'
	@touch $@

$(VENV)/.test: $(BIN)/python $(SOURCES) $(EXAMPLE)/pyproject.toml
	$(INSTALL) -e '.[all,test]' -e ./$(EXAMPLE)
	@touch $@ $(VENV)/.demo

$(VENV)/.apps: $(VENV)/.test $(APPS:%=%/pyproject.toml)
	$(INSTALL) $(APPS:%=-e './%[test]')
	@touch $@

$(VENV)/.docs: $(VENV)/.test $(SOURCES)
	$(INSTALL) --group docs
	@touch $@

$(VENV)/.dev: $(BIN)/python $(SOURCES)
	$(INSTALL) --group dev
	@touch $@

.PRECIOUS: %/bin/python

clean:
	rm -rf $(VENV) .venv-* out build dist *.egg-info $(EXAMPLE)/*.egg-info $(APPS:%=%/*.egg-info)

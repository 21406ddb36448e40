# Two commands do all the set-up: `make demo` and `make test`.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Each takes up to 5 GB, most of it compiled jax programs.
WORKERS ?= 2
INSTALL := PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet -c constraints.txt
SOURCES := pyproject.toml constraints.txt

# What tests need of the system, by Debian's names; installed where this is root or may use sudo.
SYSTEM_PACKAGES := python3-venv libegl1 libgl1-mesa-dri
SUDO := $(shell if [ "$$(id -u)" = 0 ]; then echo env; elif sudo -n true 2>/dev/null; then echo sudo; fi)

.PHONY: demo test lint clean system

demo: $(VENV)/.demo
	$(BIN)/rts demo -o out

test: system $(VENV)/.test
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

system:
	@missing=$$(for p in $(SYSTEM_PACKAGES); do dpkg -s $$p >/dev/null 2>&1 || echo $$p; done); \
	if ! command -v dpkg >/dev/null; then \
		echo "not a Debian system: install the equivalents of $(SYSTEM_PACKAGES) if tests are skipped"; \
	elif [ -n "$$missing" ] && [ -n "$(SUDO)" ]; then \
		{ $(SUDO) apt-get update -qq && $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing >/dev/null; } \
			|| echo "could not install $$missing: tests that need them are skipped"; \
	elif [ -n "$$missing" ]; then \
		echo "not root and no sudo: tests that need these Debian packages are skipped: $$missing"; \
	fi

$(BIN)/python:
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || $(MAKE) system
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.demo: $(BIN)/python $(SOURCES)
	$(INSTALL) -e '.[torch,plots]'
	@touch $@

$(VENV)/.test: $(BIN)/python $(SOURCES) tests/plugin_example/pyproject.toml
	$(INSTALL) -e '.[all,test]' -e ./tests/plugin_example
	@touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) out build *.egg-info

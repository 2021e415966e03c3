# `make train` and `make test` need Python (3.11 or newer) and make, nothing else: each creates the
# virtual environment, installs what it needs, and does its job.
#
#   make train ARGS="--steps 2e6"     options of `python -m dexsim_ppo.train`
#   make docs                         the documentation site, in site/
#   make figures                      the pictures of the documentation, anew; ARGS="skin films" for some
#   make test ARGS="-k touch"         options of pytest (which runs on two processes)
#   make test MORE=,sb3               further extras whose tests are skipped otherwise
#   make mutants ARGS="--seed 1"      an hour of small changes in the code: do the tests notice?
#   make PYTHON=python3.12 test       another interpreter (for a new .venv)
#   make EXTRAS=cuda train       other extras than the ones chosen by the device found

PYTHON ?= python3
VENV ?= .venv
ARGS ?=
MORE ?=
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check

# With an NVIDIA driver present, training goes to the GPU.
EXTRAS ?= train,video,tb$(if $(shell nvidia-smi -L 2>/dev/null),$(comma)cuda)
comma := ,

# One stamp for each set of requirements: a step runs again only when pyproject.toml has changed.
INSTALLED := $(VENV)/.installed-$(subst $(comma),-,$(EXTRAS))
TESTABLE := $(VENV)/.testable$(subst $(comma),-,$(MORE))
DOCUMENTABLE := $(VENV)/.documentable
LINTABLE := $(VENV)/.lintable
MUTABLE := $(VENV)/.mutable

.PHONY: train test mutants lint docs figures clean help
.DELETE_ON_ERROR:
.NOTPARALLEL:

help:
	@sed -n 's/^#  *\(make .*\)/  \1/p' Makefile

train: $(INSTALLED)
	$(PY) -m dexsim_ppo.train --task grasp $(ARGS)

test: $(TESTABLE)
	$(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

mutants: $(MUTABLE)
	$(PY) benchmarks/mutants.py $(ARGS)

lint: $(LINTABLE)
	$(PY) -m ruff check $(ARGS)
	$(PY) -m ruff format --check
	$(PY) -m mypy

docs: $(DOCUMENTABLE)
	$(PY) -m mkdocs build --strict $(ARGS)

figures: $(TESTABLE)
	$(PY) docs/images/figures.py $(ARGS)

clean:
	rm -rf $(VENV) dist site .cache .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

# pip 25.1 is the first that knows dependency groups.
$(VENV)/.created:
	@echo "making a virtual environment in $(VENV)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "dexsim needs Python 3.11 or newer; name one with: make PYTHON=python3.12 ..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --upgrade "pip>=25.1"
	@touch $@

$(INSTALLED): pyproject.toml | $(VENV)/.created
	@echo "installing dexsim and what it needs into $(VENV), the first time some minutes"
	$(PIP) install --editable ".[$(EXTRAS)]"
	@touch $@

$(TESTABLE): pyproject.toml | $(VENV)/.created
	$(PIP) install --quiet --editable ".[train,brax,video,tb,onnx,lerobot,gym,docs$(MORE)]" --group test
	@touch $@

$(MUTABLE): $(TESTABLE)
	$(PIP) install --quiet --group mutants
	@touch $@

# With the extras whose modules the reference imports.
$(DOCUMENTABLE): pyproject.toml | $(VENV)/.created
	$(PIP) install --quiet --editable ".[docs,real]"
	@touch $@

# With the packages, since mypy reads the types of JAX and NumPy.
$(LINTABLE): pyproject.toml | $(VENV)/.created
	$(PIP) install --quiet --editable ".[train]" --group lint
	@touch $@

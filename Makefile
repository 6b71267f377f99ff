# make demo: makes scenes, trains a shipped network further on them, exports and simulates it, in minutes on two CPU cores
# make test: the tests        make slow: those that compile, and the notebooks        make check: all that CI runs
PYTHON ?= $(shell command -v python3.12 >/dev/null 2>&1 && python3.12 --version >/dev/null 2>&1 && echo python3.12 \
	|| (command -v python3.11 >/dev/null 2>&1 && python3.11 --version >/dev/null 2>&1 && echo python3.11) || echo python3)
VENV := .venv
RUN := $(VENV)/bin/python
DEMO := runs/demo
# one more than the two cores that this is measured on: a fifth of the time tests wait
TEST_PROCESSES ?= 3

# the tests start a hundred processes, each of which would compile the package anew
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test slow soak check format lint types layers docs film clean

setup: $(VENV)/.installed

INSTALL = .ci/install $(VENV)

# modules are compiled as they are used, but Taichi here: Python warns of it as it compiles it
COMPILE = $(RUN) -W ignore -m compileall -q $(VENV)/lib/python*/site-packages/taichi

$(VENV)/.created:
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 13) and "Python 3.11 or 3.12 is needed (Taichi), got " + sys.version.split()[0] + "; name one with make PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/.created
	$(INSTALL) -e '.[dev]'
	$(COMPILE)
	@touch $@ $(VENV)/.demo
	@echo "installed; '. $(VENV)/bin/activate', and 'python -m hgn.rollout' simulates a scene"

# what the demo needs alone: the tests' packages are larger
$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)/.created
	$(INSTALL) -e '.[datagen,train]'
	$(COMPILE)
	@touch $@

demo: $(VENV)/.demo
	@echo "== 1 of 4: generating MPM episodes, and training the shipped network obstacles_small further on them"
	$(RUN) -m hgn.train +experiment=demo
	@echo "== 2 of 4: exporting inference weights"
	$(RUN) -m hgn.export checkpoint=$(DEMO)/checkpoints/best.ckpt out=$(DEMO)/weights.safetensors
	@echo "== 3 of 4: simulating a validation scene, and drawing it with its ground truth"
	$(RUN) -m hgn.rollout weights=$(DEMO)/weights.safetensors data=data/demo episode=validation-000000 frames=40 render=false out=$(DEMO)/rollout.vtkhdf
	$(RUN) -m tools.render rollout=$(DEMO)/rollout.vtkhdf out=$(DEMO)/pictures every=2
	@echo "== 4 of 4: errors"
	$(RUN) -m hgn.evaluate weights=$(DEMO)/weights.safetensors data=data/demo json=$(DEMO)/errors.json
	@echo "weights: $(DEMO)/weights.safetensors"
	@echo "rollout: $(DEMO)/rollout.vtkhdf (HDF5; ParaView opens it)"
	@echo "picture: $(DEMO)/pictures/rollout.png, moving: $(DEMO)/pictures/rollout.gif: a scene that the network was not"
	@echo "trained on. Its prediction is above (PNG) or on the left (GIF). In both, the bodies meet on the obstacle. On the"
	@echo "floor, the water of this small network spreads less evenly than the solver's."

test: setup
	@echo "about 7 minutes on two free cores; at the end: which tests were skipped, and why (no GPU, no namespaces, ...)"
	$(RUN) -m pytest -n $(TEST_PROCESSES) -rs

# exported packages and all kernels for an H100 are compiled, notebooks run; CI runs these tests after the others
slow: setup
	$(RUN) -m pytest -n $(TEST_PROCESSES) -m slow

# each decoder reads 5,000 damaged files, other ones each time, and two viewers act for two minutes; not in CI
soak: setup
	$(RUN) -m pytest tests/scene/test_hostile_files.py tests/viewer/test_strangers.py -m "" -k "any_bytes or two_viewers" --soak 5000

check: setup format lint types layers docs test slow

format: setup
	$(RUN) -m ruff format --check

lint: setup
	$(RUN) -m ruff check

types: setup
	$(RUN) -m mypy

layers: setup
	$(VENV)/bin/lint-imports

docs: setup
	$(RUN) -m sphinx -W --keep-going -n -q -b html docs docs/_build
	@echo "docs/_build/index.html"

# a simulation as a page that plays by itself, which the docs show where it is
film: setup
	$(RUN) -m hgn.rollout scene=play frames=150 render=false out=runs/film/film.vtkhdf
	$(RUN) -m hgn.play rollout=runs/film/film.vtkhdf html=docs/_static/film.html

clean:
	rm -rf $(VENV) build dist docs/_build docs/_generated

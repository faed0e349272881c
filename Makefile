# Each target does its own set-up on a fresh machine: a virtual environment in .venv with everything installed, for the
# demo only what it needs.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_STAMP := $(VENV)/.installed-for-the-demo
CHOSEN := $(if $(filter file,$(origin PYTHON)),,python)
PIP_QUIET := $(if $(MAKE_TERMOUT),,-qq)

# Unit tests: those that start no Ray, simulator, robot server, proxy or storage, open no browser, train nothing and do
# not wait for time to pass.
UNITS := tests/policy tests/recording tests/client tests/drive tests/serve_app tests/envs/test_registration.py \
	tests/export/checkpoints/test_experiment.py tests/test_layout.py tests/test_package.py tests/test_private_names.py
NOT_UNITS := $(addprefix --ignore=tests/, client/test_bad_line.py client/test_client_faults.py recording/replay \
	serve_app/engines serve_app/repository/test_remote_repository.py)

# The extras without gigabytes; the cockpit's viser limits websockets and rich to old releases.
ENDS_EXTRAS := client,serve,sim,record,remote
TEST_TOOLS := 'pytest>=8' pytest-timeout pytest-xdist pytest-random-order httpx pyyaml jsonschema playwright \
	'moto[server]' onnx matplotlib

.PHONY: demo test quick newest oldest check docs bench wheel release setup python clean

demo: $(if $(wildcard $(STAMP)),setup,$(CHOSEN) $(DEMO_STAMP))  ## Export the two shipped checkpoints, serve them, drive both simulators; a table and a picture in demo/
	$(BIN)/rlservo demo --out demo

test: setup  ## All tests, or those of TESTS, in five processes on two cores: many wait; then those in real time
	@status=0; run() { echo "pytest $$*"; $(BIN)/python -m pytest "$$@" $(TESTS) || [ $$? = 5 ]; }; \
	run -n 5 -m "not realtime" || status=1; \
	run -n 3 -m realtime || run -m realtime --last-failed || status=1; \
	exit $$status  # 5: TESTS has none of this part; a busy machine misses a watchdog of 0.1 s: those once more, alone

quick: setup  ## Unit tests, in a minute on two cores that nothing else uses
	$(BIN)/python -m pytest -n 4 -m "not slow and not serve and not trained and not browser" $(NOT_UNITS) $(UNITS)

newest oldest:  ## Unit tests with the newest, or the oldest, release of every dependency, in .newest or .oldest
	$(PYTHON) -m venv --clear .$@
	.$@/bin/python -m pip install $(PIP_QUIET) uv
	.$@/bin/uv pip install --python .$@/bin/python --resolution $(if $(filter oldest,$@),lowest-direct,highest) \
		-e '.[$(ENDS_EXTRAS)]'
	.$@/bin/uv pip freeze --python .$@/bin/python --exclude-editable > .$@/installed.txt
	.$@/bin/uv pip install --python .$@/bin/python -c .$@/installed.txt $(TEST_TOOLS)
	# An old release with a new dependency warns of deprecated names.
	PYTEST_ADDOPTS="-p no:anyio $(if $(filter oldest,$@),-W ignore::DeprecationWarning)" \
		$(MAKE) --old-file=setup quick VENV=.$@

check: setup  ## Lint, format and types, as CI runs them
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pyright

docs: setup  ## The site into site/; a broken link or an undocumented public name fails
	$(BIN)/python .ci/reference.py --check
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	$(BIN)/python .ci/demo_pages.py site/demo  # pages of policies, from npm's libraries; left out without a network

bench: setup  ## Simulator, training, and export speed, printed and written to bench/
	$(BIN)/python benchmarks/simulators.py
	$(BIN)/python benchmarks/robot_server.py
	$(BIN)/python benchmarks/vectorisation.py --quick
	$(BIN)/python benchmarks/training.py --quick
	$(BIN)/python benchmarks/export_policy.py

wheel: setup  ## Build the wheel into dist/
	$(BIN)/python -m build --wheel --outdir dist .

release: setup  ## Wheel and sdist into dist/, checked, and each installed and run in an empty environment
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python .ci/try_release.py dist

setup: $(CHOSEN) $(STAMP)  ## Only the set-up

python:  # if one was named
	$(PYTHON) .ci/check_python.py $(VENV)

# pip's own output on a terminal; elsewhere only errors.
$(STAMP): EXTRAS := all,dev,docs
$(DEMO_STAMP): EXTRAS := serve,ray,train,sim,cockpit
$(STAMP) $(DEMO_STAMP): pyproject.toml constraints.txt
	$(PYTHON) .ci/check_python.py $(VENV)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)  # another Python of the same version would mix two
	@echo "installing [$(EXTRAS)] into $(VENV): a few minutes"
	$(BIN)/python -m pip install $(PIP_QUIET) -c constraints.txt --upgrade pip  # Debian's resolves for ten minutes and more
	$(BIN)/python -m pip install $(PIP_QUIET) -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@

clean:  ## Remove the other targets' output, .venv included
	rm -rf $(VENV) .newest .oldest demo bench build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache

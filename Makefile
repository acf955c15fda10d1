# The commands of a day's work.  Each makes its own environment (.venv) if there is none.
PYTHON_IN = .venv/bin
READY = .venv/.ready

.PHONY: bench demo faults fuzz long-night night-demo test lint package check docs format clean

demo: $(READY) ## a simulated capture of the horizontal stand, measured from photographs to report
	@rm -rf demo/capture
	$(PYTHON_IN)/nlights simulate demo/capture --stand horizontal --scene painting --width 1000 --seed 1
	$(PYTHON_IN)/nlights digitise demo/capture/artwork.yaml --recipe default --out demo/products
	$(PYTHON_IN)/nlights evaluate demo/products/simulated-painting/r0c0 --truth demo/capture/truth
	@echo
	@echo "Look at demo/products/simulated-painting/r0c0/report.html"

night-demo: $(READY) ## a night with PostgreSQL, a Prefect server and a worker, all on this machine
	$(PYTHON_IN)/python deploy/night_demo.py $(OPTIONS)

KILLS = 20
faults: $(READY) ## nights that are killed, KILLS of them, each of whose calls fails, and other faults (docs/faults.md)
	$(PYTHON_IN)/python deploy/fault_conditions.py
	$(PYTHON_IN)/python deploy/fault_each.py $(if $(TRIES),--tries $(TRIES) --power $(TRIES))
	$(PYTHON_IN)/python deploy/fault_kills.py --kills $(KILLS) $(OPTIONS)

long-night: $(READY) ## a night of 1000 tiny tiles, twice, to see that nothing grows (some 20 minutes)
	$(PYTHON_IN)/python deploy/fault_many.py $(OPTIONS)

EXAMPLES = 200000
fuzz: $(READY) ## files of people, spoilt at random: EXAMPLES of each kind, others each time (some half an hour)
	NLIGHTS_FUZZ=$(EXAMPLES) $(PYTHON_IN)/python -m pytest --numprocesses auto --maxprocesses 4 tests/fuzz $(OPTIONS)

test: $(READY) ## all tests, on up to four cores; each file's one after the other
	$(PYTHON_IN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

lint: $(READY) ## style, types, layers
	$(PYTHON_IN)/ruff check .
	$(PYTHON_IN)/ruff format --check .
	$(PYTHON_IN)/mypy
	$(PYTHON_IN)/lint-imports

package: $(READY) ## the wheel, in a clean environment, with the example plugin and every recipe
	$(PYTHON_IN)/python tests/package_check.py

bench: $(READY) ## the chain against what its bytes cost, up to 102 megapixels (some 15 minutes, 35 GB)
	cd benchmarks && ../$(PYTHON_IN)/python full_size.py

check: lint test package ## what CI runs

docs: $(READY) ## docs/ as a site in build/docs; a link that leads nowhere is an error
	$(PYTHON_IN)/python -m sphinx -b html -W --keep-going -n -q docs build/docs
	@echo "Look at build/docs/README.html"

format: $(READY)
	$(PYTHON_IN)/ruff check --fix .
	$(PYTHON_IN)/ruff format .

clean:
	rm -rf .venv demo dist build

$(READY): pyproject.toml constraints.txt deploy/make-environment
	sh deploy/make-environment .venv
	@touch $@

# make demo            three virtual recordings to a report; prints the report's path at the end
# make test            the tests, on all cores (PYTEST=-n0 for one process)
# make test-fast       without the tests that start processes, render captures or fit sequences
# make test-all        all tests: also every browser and Slurm test, chaos and fuzz
# make test-slurm      the workflow on a real Slurm (Debian: slurm-wlm, munge; as root), with faults
# make chaos           runs that are killed, disks that are full, results that are damaged
# make fuzz            damaged files of every kind that a user supplies
# make cases           input files that reproduce public bug reports
# make lint            ruff, import-linter, snakefmt, mypy, snakemake --lint
# make mediapipe       environment of a real keypoint detector, for make evaluate
# make evaluate        all evaluation recordings against truth, into results/evaluation.json
# make evaluate-quick  six recordings; fails if a figure is worse than bench/reference-quick.json
# make bench           seconds per frame and memory, also of the paper's recipe
# make ablation        the joint fit without each of its terms (after make evaluate-quick)
# make oracle          the joint fit with true cameras and meshes (after make evaluate-quick)
# make annotate-driven errors of a project before and after its annotation in a browser
# make report          the site of the demo, from the results that are there
# make scale           223 sequences: a start with nothing to do, a check, the jobs of an edit
# make scale-report    the site of 223 sequences of 300 frames
# make docs            generated pages and schemas, and the rule graph
#
# Figures of bench, ablation, oracle, scale, chaos, fuzz, cases and test-slurm go to results/*.json.
PYTHON ?= python3
VENV ?= .venv
CORES ?= 0
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
MEDIAPIPE := .venv-mediapipe
TORCH := torch==2.13.0
EXTRAS := workflow,test,bench,dev
RUN_TESTS = $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-fast test-all test-slurm lint ruff-check ruff-format imports snakefmt mypy \
    snakemake-lint mediapipe evaluate evaluate-quick bench ablation oracle annotate-driven report scale-report scale fuzz cases chaos \
    docs environment clean

demo: $(STAMP)
	$(BIN)/intercap run config/demo/config.yaml --cores $(CORES)

test: $(STAMP)
	$(RUN_TESTS) -m "not full" $(PYTEST)

test-fast: $(STAMP)
	$(RUN_TESTS) -m "not slow and not full" $(PYTEST)

test-all: $(STAMP)
	$(RUN_TESTS) $(PYTEST)
	$(BIN)/python -m bench.slurm
	$(BIN)/python -m tests.chaos.run
	$(BIN)/python -m tests.fuzz.run

test-slurm: $(STAMP)
	$(BIN)/python -m bench.slurm $(PYTEST)

lint: ruff-check ruff-format imports snakefmt mypy snakemake-lint

ruff-check: $(STAMP)
	$(BIN)/ruff check .

ruff-format: $(STAMP)
	$(BIN)/ruff format --check .

imports: $(STAMP)
	$(BIN)/lint-imports

snakefmt: $(STAMP)
	$(BIN)/snakefmt --check workflow

mypy: $(STAMP)
	$(BIN)/mypy

snakemake-lint: $(STAMP)
	$(BIN)/snakemake --lint --configfile config/demo/config.yaml

# MediaPipe needs NumPy 1 and uses little of what it lists as required
$(MEDIAPIPE)/.installed:
	$(PYTHON) -m venv $(MEDIAPIPE)
	$(MEDIAPIPE)/bin/pip install --quiet "numpy<2" "opencv-python-headless<4.12" absl-py attrs flatbuffers \
	    "protobuf<5" matplotlib
	$(MEDIAPIPE)/bin/pip install --quiet --no-deps mediapipe==0.10.21
	touch $@

mediapipe: $(MEDIAPIPE)/.installed

# without MediaPipe (Python 3.13 and later), the area detector is left out
evaluate: $(STAMP)
	-$(MAKE) --no-print-directory mediapipe
	$(BIN)/intercap dev evaluate --cores $(CORES)

evaluate-quick: $(STAMP)
	$(BIN)/intercap dev evaluate --quick --output results/evaluation-quick.json --cores $(CORES)

bench: $(STAMP)
	$(BIN)/intercap dev bench --cores $(CORES)
	$(BIN)/python -m bench.object_speed
	$(BIN)/python -m bench.body_speed
	$(BIN)/python -m bench.joint_speed

ablation: $(STAMP)
	$(BIN)/python -m bench.ablation

oracle: $(STAMP)
	$(BIN)/python -m bench.oracle --cores $(CORES)

annotate-driven: $(STAMP)
	$(BIN)/python -m bench.annotate_driven --cores $(CORES)

report: $(STAMP)
	$(BIN)/intercap report config/demo/config.yaml

scale-report: $(STAMP)
	$(BIN)/python -m bench.scale_report

scale: $(STAMP)
	$(BIN)/intercap run config/test/config.yaml --cores $(CORES)
	$(BIN)/python -m bench.scale

fuzz: $(STAMP)
	$(BIN)/python -m tests.fuzz.run

cases: $(STAMP)
	$(BIN)/python -m tests.cases.run

chaos: $(STAMP)
	$(BIN)/python -m tests.chaos.run

docs: $(STAMP)
	$(BIN)/intercap dev docs
	$(BIN)/python tools/write_rule_graph.py

environment: $(STAMP)

# The stamp is older than pyproject.toml if the requirements have changed. Torch is installed first, by
# its exact version: pip would otherwise download several large builds to choose from.
# For a build without CUDA: PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu.
$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[$(EXTRAS)]"
	touch $@

clean:
	rm -rf results logs benchmarks .snakemake

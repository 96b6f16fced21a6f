# make demo      three virtual recordings, everything computed, the report's path at the end
# make test      the whole test suite, on all cores (PYTEST=-n0 for one process)
# make test-fast what a developer runs after each edit: all tests but the slow ones, which start
#                processes, render whole captures or fit whole sequences
# make test-slurm  the workflow on a real Slurm (Debian: slurm-wlm, munge; as root), the small dataset as
#                jobs and what goes wrong on clusters, into results/bench.json; a short part is in `make test`
# make lint      ruff, import-linter, snakefmt, mypy, snakemake --lint
# make evaluate  the evaluation captures against truth (those of config/capture to the scene alone,
#                of config/object to the object's track and the body's fit, those of config/body to
#                the latter), tables and results/evaluation.json; about an hour on two cores, goes
#                on where it was ended. Then, on three of them, the joint fit's oracle floors and what
#                a mesh with holes costs it; last, two recordings mended in a real browser
# make evaluate-quick  six recordings to the end within ten minutes, beside the recorded figures
# make bench     seconds a frame and peak memory, extraction alone and its bytes, the object's tracker,
#                the body's fit and the joint stage beside the paper's recipe, the joint stage's memory
#                on long sequences, results/bench.json
# make ablation  what each term of the joint fit is worth: the fit without it on the recordings of
#                evaluate-quick (run that first), a table, results/ablation.json and three pictures
# make oracle    how far the studio's cameras, depth biases and mesh take the joint fit, and what a mesh
#                with holes costs it, on the recordings of evaluate-quick (run that first):
#                results/oracle.json
# make report    the site of the demo from what is computed
# make scale-report  what 223 sequences of 300 frames cost the site, of the demo's (run that first):
#                into results/bench.json
# make scale     223 sequences: a start with nothing to do, a check, the jobs of an edit, into
#                results/bench.json
# make fuzz      10,000 damaged files of every kind that a user supplies, each read in a process of its
#                own: accepted and plausible, or refused by name; into results/bench.json. A quarter of
#                an hour on two cores; what it prints reproduces a case
# make chaos     a small dataset whose runs are killed in every stage, whose disk is full, whose results
#                are damaged, whose clock jumps; each time one command goes on, and in the end every
#                byte is as without: into results/bench.json. A quarter of an hour; as root also disks
# make docs      the generated pages and schemas, and the rule graph
PYTHON ?= python3
VENV ?= .venv
CORES ?= 0
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TORCH := torch==2.13.0
EXTRAS := workflow,test,bench,dev

.PHONY: demo test test-fast test-slurm lint ruff-check ruff-format imports snakefmt mypy \
    snakemake-lint evaluate evaluate-quick bench ablation oracle report scale-report scale fuzz chaos \
    docs environment clean

demo: $(STAMP)
	$(BIN)/intercap run config/demo/config.yaml --cores $(CORES)

# A file's tests stay on one worker, and those that share a whole run: see tests/conftest.py.
test: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder $(PYTEST)

test-fast: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder -m "not slow" $(PYTEST)

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
	$(BIN)/snakefmt --check Snakefile workflow

mypy: $(STAMP)
	$(BIN)/mypy

snakemake-lint: $(STAMP)
	$(BIN)/snakemake --lint --configfile config/demo/config.yaml

evaluate: $(STAMP)
	$(BIN)/intercap evaluate --cores $(CORES)
	$(BIN)/python -m bench.oracle config/object/config.yaml --output results/evaluation.json \
	    --sequences cup_drink_s02 suitcase_carry_s10 stool_sit_s07 --cores $(CORES) \
	    --variants "as it is" "true mesh" "starts at the truth" "open mesh"
	$(BIN)/python -m bench.annotate_driven --cores $(CORES)

evaluate-quick: $(STAMP)
	$(BIN)/intercap evaluate --quick --output results/evaluation-quick.json --cores $(CORES)

bench: $(STAMP)
	$(BIN)/intercap bench --cores $(CORES)
	$(BIN)/python -m bench.object_speed
	$(BIN)/python -m bench.body_speed
	$(BIN)/python -m bench.joint_speed

ablation: $(STAMP)
	$(BIN)/python -m bench.ablation

oracle: $(STAMP)
	$(BIN)/python -m bench.oracle --cores $(CORES)

report: $(STAMP)
	$(BIN)/intercap report config/demo/config.yaml

scale-report: $(STAMP)
	$(BIN)/python -m bench.scale_report

scale: $(STAMP)
	$(BIN)/intercap run config/test/config.yaml --cores $(CORES)
	$(BIN)/python -m bench.scale

fuzz: $(STAMP)
	$(BIN)/python -m tests.fuzz.run

chaos: $(STAMP)
	$(BIN)/python -m tests.chaos.run

docs: $(STAMP)
	$(BIN)/intercap docs
	$(BIN)/python tools/write_rule_graph.py

environment: $(STAMP)

# A stamp, so that the environment is made once, and again only when what it needs has changed. Torch
# comes first and by its exact version, so that pip does not fetch several of its large builds to
# choose from. For a build without CUDA: PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu.
$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[$(EXTRAS)]"
	touch $@

clean:
	rm -rf results logs benchmarks .snakemake

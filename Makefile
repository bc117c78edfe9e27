# groundwalk: phone captures in, checked ground truth, regressors, fusion and tables out. `make help` lists what there is.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

scene ?=
profile ?= demo
captures ?=
web ?=
roots ?=
stability ?=
python ?= python3

# What the user gives is text, never make's or the shell's language: it's read unexpanded, and recipes get it through the
# environment. What a scene is made of, and what of it is up to date, `groundwalk run` decides.
profile_is_given := $(filter command,$(origin profile))
override scene := $(value scene)
override profile := $(value profile)
override captures := $(value captures)
override web := $(value web)
override roots := $(value roots)
override stability := $(value stability)
export scene profile captures roots

py := .venv/bin/python
installed := .venv/.installed
stages := import sfm align localise train fuse report
arguments := --scene "$$scene" --profile "$$profile"

scene_goals := all $(stages) simulate view clean
ifneq ($(filter $(scene_goals),$(MAKECMDGOALS)),)
ifeq ($(scene),)
$(error name a scene, for example `make scene=Church all`; `make help` lists the scenes)
endif
endif
ifneq ($(filter judge public,$(MAKECMDGOALS)),)
ifeq ($(captures),)
$(error name a folder of captures: `make captures=<folder> $(firstword $(filter judge public,$(MAKECMDGOALS)))`)
endif
endif

# ---------------------------------------------------------------- installation
# constraints.txt pins each package on every platform. hashes.txt has their hashes, but for torch and the CUDA packages that
# it brings, which indexes build on their own; pip takes no hashes of constraints, so these come first.
$(installed): pyproject.toml constraints.txt hashes.txt
	@echo "Installing into .venv (4.2 GB, a few minutes; once)"
	@$(python) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "error: Python 3.11 or later is needed, found $$($(python) --version); name one: make python=python3.12 ..."; exit 2; }
	@$(python) -m venv .venv
	@.venv/bin/pip install --quiet --disable-pip-version-check --require-hashes --no-deps -r hashes.txt
	@.venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

install: $(installed) ## Create .venv from the pinned dependencies

# ---------------------------------------------------------------- for users
judge: | $(installed) ## captures=<folder>: which frames can be trusted, on one page, in minutes
	@$(py) -m groundwalk judge "$$captures"

all: report ## Everything: import, sfm, align, localise, train, fuse, report
import: ## Stage 1: any capture -> checked frames
sfm: ## Stage 2: frames -> COLMAP model
align: ## Stage 3: model and VIO -> metric, gravity-aligned ground truth; drift
localise: ## Stage 4: maps of points, and the poses that structure localisers give in them
train: ## Stage 5: absolute pose regressors, and their predictions
fuse: ## Stage 6: predictions and VIO -> fused poses and errors
report: ## Stage 7: the page again, tables, figures
$(stages): | $(installed)
	@$(py) -m groundwalk run $(arguments) $(if $(captures),--captures "$$captures") --until $@

simulate: | $(installed) #! Simulate the scene's captures, where it has none
	@$(py) -m groundwalk simulate $(arguments)

paper: | $(installed) #! All six scenes, one regressor for all outdoors and one indoors, and one page; profile paper (profile=demo: hours)
	@$(py) -m groundwalk run --scene paper --profile "$(if $(profile_is_given),$$profile,paper)"

plan: | $(installed) #! What the paper's six scenes would take, by finished runs; profile paper
	@$(py) -m groundwalk plan --profile "$(if $(profile_is_given),$$profile,paper)"

public: $(installed) #! Scenes of 7-Scenes and Cambridge Landmarks, up to train, and their table: captures=<folder with chess, ...>; a GPU for a day
	@$(py) -m benchmarks.datasets --captures "$$captures" --profile "$(if $(profile_is_given),$$profile,paper)"

view: | $(installed) ## Open the scene's recordings in the Rerun viewer (web=1: in a browser)
	@$(py) -m groundwalk view $(arguments) $(if $(web),--web)

clean: | $(installed) ## Remove the scene's artefacts of this profile and its simulated captures; never a real capture
	@$(py) -m groundwalk clean $(arguments)

# ---------------------------------------------------------------- development
check: lint types #! Lint, format, types, layering
	@$(py) -m pytest --quiet tests/test_layering.py

lint: $(installed) #! Lint and format
	@.venv/bin/ruff check --quiet .
	@.venv/bin/ruff format --quiet --check .

types: #! Types alone, of whatever is installed in .venv
	@.venv/bin/mypy --no-error-summary

# mypy works on one core: it runs beside the tests.
test: lint #! Checks and tests, under ten minutes on two cores
	@mkdir -p build; $(MAKE) --no-print-directory types > build/types.txt 2>&1 & types=$$!; \
		OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(py) -m pytest -n 2 --dist worksteal -m "not slow"; tests=$$?; \
		wait $$types && exit $$tests; cat build/types.txt; exit 1

test-page: $(installed) #! Reports' page in a real browser: needs chromium and the extra `page` (pip install -e '.[page]')
	@$(py) -m pytest -rs -s tests/reports/test_browser.py

test-slow: $(installed) #! Whole-pipeline cases
	@$(py) -m pytest -m slow

test-faults: $(installed) #! Damage, kills, full disks, hostile names and texts: a table of faults
	@$(py) -m benchmarks.faults

audit: #! Known vulnerabilities of the pinned dependencies (pip-audit); needs a network
	@$(python) -m venv build/audit
	@build/audit/bin/pip install --quiet --disable-pip-version-check pip-audit
	@build/audit/bin/pip-audit --requirement constraints.txt --no-deps --disable-pip

bench-localise: $(installed) #! Structure localisers Map and HLoc against the figures to reach (docs/results); finished runs
	@$(py) -m benchmarks.localise

bench-phone: $(installed) #! Exported regressors without PyTorch: bytes, milliseconds, int8 against fp32 (docs/results); a finished run; roots=<folders, joined by commas>: trainings of bench-regressors (build/regressors/PN-0,...)
	@$(py) -m benchmarks.phone --scene "$${scene:-Church}" --profile "$$profile" $(if $(roots),--data "$$roots")

bench-regressors: $(installed) #! PN, MS-T and PN-Lite beside each other, 3 seeds (docs/results); finished runs of Church and Office; hours
	@$(py) -m benchmarks.regressors

bench-recovery: $(installed) #! How fusion methods bear what goes wrong in a walk, and how they start
	@$(py) -m benchmarks.fusion_recovery

bench-scale: $(installed) #! Import, sfm and align of one place with 500, 1,000 and 2,500 frames (docs/results); hours
	@$(py) -m benchmarks.scale sizes

bench-campaign: $(installed) #! A campaign with jobs and Snakemake killed; planning of many scenes (docs/results); hours
	@$(py) -m benchmarks.campaign

bench-steps: $(installed) #! What a step of drift_aware costs over a walk of half an hour (docs/results)
	@$(py) -m benchmarks.fusion_steps

bench-gates: $(installed) #! Broken and clean simulated captures, and what the checks say of them (docs/results); hours
	@$(py) -m benchmarks.gates

bench-real: $(installed) #! Real captures beside stock COLMAP (docs/results); captures=<folder>: yours, too; stability=1: resampled
	@$(py) -m benchmarks.real $(if $(captures),--capture "$$captures") $(if $(stability),--stability)

bench-images: $(installed) #! Photos and video alone, of real captures, against the phone's poses (docs/results)
	@$(py) -m benchmarks.images_alone

bench-measured: $(installed) #! Photos against cameras measured by laser (docs/results); scenes=<folder of a public data set>
	@$(py) -m benchmarks.measured_cameras --scenes "$(scenes)"

bench-cameras: $(installed) #! Simulated phones whose lens, shutter and focus are unknown (docs/results); hours
	@$(py) -m benchmarks.phone_cameras

bench-blurring: $(installed) #! What blurring of faces finds, and what it blurs for nothing (docs/results); captures=<folder that shows nobody> labelled=<dlib's examples/faces> face_model=<YuNet's file>
	@$(py) -m benchmarks.import_blurring $(if $(captures),--captures $(captures)) $(if $(labelled),--labelled $(labelled)) $(if $(face_model),--face-model $(face_model))

docs: $(installed) #! Write the generated pages of docs/reference: tables, settings, commands, checks
	@$(py) -m benchmarks.reference

docs-site: $(installed) #! Build the documentation as a site, strictly, into build/site
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict
	@echo "Look at build/site/index.html"

pictures: $(installed) #! Take docs/images/page.jpg and recordings.jpg of a finished run (scene=Church profile=demo unless named); needs chromium and a Vulkan driver
	@$(py) -m benchmarks.pictures --scene "$${scene:-Church}" --profile "$$profile"

lock: #! Resolve the dependencies again into constraints.txt and hashes.txt (needs uv)
	uv pip compile --universal --extra dev --python-version 3.11 --no-annotate --upgrade pyproject.toml -o constraints.txt
	grep -vE '^(torch|triton|cuda-|nvidia-)' constraints.txt | uv pip compile --universal --no-deps --python-version 3.11 \
		--no-annotate --no-header --generate-hashes - -o hashes.txt

help: #! What a user needs
	@echo "make scene=<scene> [profile=demo|standard|paper|tiny] [captures=<folder>] <target>"
	@echo
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14 | sed 's/^/  /'
	@echo "  help-dev    the targets for whoever changes groundwalk: tests, benchmarks, docs"
	@echo
	@if [ -e $(installed) ]; then $(py) -m groundwalk scenes; echo; fi
	@echo "your own captures:  make scene=<name> captures=<folder> all"
	@echo "every command:      .venv/bin/groundwalk --help   (.venv/bin/groundwalk sfm --help: one stage's settings)"

help-dev: #! This text
	@grep -hE '^[a-z-]+:.*#! ' $(MAKEFILE_LIST) | sed 's/:.*#! /\t/' | expand -t 22 | sed 's/^/  /'

.NOTPARALLEL:
.PHONY: all judge $(stages) simulate install paper plan public view clean check lint types test test-slow test-faults audit bench-localise bench-phone bench-regressors bench-recovery bench-scale bench-campaign bench-steps bench-gates bench-real bench-images bench-measured bench-cameras bench-blurring docs docs-site pictures test-page lock help help-dev

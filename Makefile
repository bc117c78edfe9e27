# groundwalk: phone captures in, checked ground truth, regressors, fusion and tables out. `make help` lists what there is.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

scene ?=
profile ?= demo
captures ?=
web ?=
seconds ?= 60
nerfstudio ?=
official ?=
python ?= python3

# What the user gives is text, never make's or the shell's language: it's read unexpanded, names have to pass a check
# before a shell sees them, and recipes get all of it through the environment.
profile_is_given := $(filter command,$(origin profile))
override scene := $(value scene)
override profile := $(value profile)
override captures := $(value captures)
override web := $(value web)
override seconds := $(value seconds)
override nerfstudio := $(value nerfstudio)
override official := $(value official)
export scene profile captures seconds nerfstudio official

name_characters := a b c d e f g h i j k l m n o p q r s t u v w x y z \
	A B C D E F G H I J K L M N O P Q R S T U V W X Y Z 0 1 2 3 4 5 6 7 8 9 - _
# $(call check_name,variable): an error unless each word character of its value may stand in a name.
define check_name
$(eval rest := $$($(1)))$(foreach c,$(name_characters),$(eval rest := $$(subst $(c),,$$(rest))))
ifneq ([$$(rest)],[])
$$(error error: a $(1)'s name has only letters a-z or A-Z, digits, - and _; the given $(1) has something else)
endif
endef
$(eval $(call check_name,scene))
$(eval $(call check_name,profile))
ifeq ($(profile),)
$(error error: the profile is empty; `make help` lists the profiles)
endif

py := .venv/bin/python
installed := .venv/.installed
run := data/runs/$(profile)/$(scene)
capture := data/captures/$(scene)
stages := import sfm align localise train fuse report
arguments := --scene "$$scene" --profile "$$profile"
scene_goals := all $(stages) simulate view clean
FORCE:

# Stages put finished artefacts in place by a rename: whatever stops make, there's nothing half-written to delete.
.PRECIOUS: $(stages:%=$(run)/%/manifest.json) $(capture)/SIMULATED.json

ifneq ($(filter $(scene_goals),$(MAKECMDGOALS)),)
ifeq ($(scene),)
$(error name a scene, for example `make scene=Church all`; `make help` lists the scenes)
endif
endif

# ---------------------------------------------------------------- installation
# One lock file for every platform: constraints.txt pins each package that pip resolves.
$(installed): pyproject.toml constraints.txt
	@echo "Installing into .venv (3.6 GB, a few minutes; once)"
	@$(python) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "error: Python 3.11 or later is needed, found $$($(python) --version); name one: make python=python3.12 ..."; exit 2; }
	@$(python) -m venv .venv
	@.venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

install: $(installed) ## Create .venv from the pinned dependencies

# ---------------------------------------------------------------- captures
# A folder of one's own is linked, not copied: data/captures/<scene> -> captures=<folder>.
ifneq ($(captures),)
ifneq ($(words $(captures))$(realpath $(captures)),1$(or $(realpath $(capture)),none))
link := link-captures
endif
endif
link-captures: | $(installed)
	@$(py) -m groundwalk.artefacts link-captures --scene "$$scene" --folder "$$captures"

# A scene without a file depends on the folder, which changes when a file of it is taken away.
settings := data/profiles/$(profile).toml $(or $(wildcard data/scenes/$(scene).toml),data/scenes)

# Predictions of other regressors, which scenes' settings name; train itself knows which of them it depends on.
predictions := $(wildcard data/predictions/*)

# A scene that simulation/ knows is simulated where nobody has put captures of it.
has_captures := $(shell find -L "$(capture)" -type f -print -quit 2>/dev/null)
is_simulated := $(wildcard $(capture)/SIMULATED.json)
simulable := $(shell grep -qs '^can_simulate = true' "data/scenes/$(scene).toml" && echo yes)
ifeq ($(captures)$(simulable),yes)
ifneq ($(is_simulated)$(if $(has_captures),,none),)
simulated := $(capture)/SIMULATED.json
endif
endif
$(capture)/SIMULATED.json: $(settings) | $(installed)
	@$(py) -m groundwalk.simulation $(arguments)

simulate: $(capture)/SIMULATED.json ## Simulate the scene's captures, where it has none

# ---------------------------------------------------------------- stages
# A group of scenes (outdoor, indoor) shares one model; its members come first.
members := $(shell sed -n 's/^members = \[\(.*\)\]/\1/p' "data/scenes/$(scene).toml" 2>/dev/null | tr -d '",')
member := $(subst $() ,,$(members))
$(eval $(call check_name,member))

ifeq ($(members),)
# Anything newer than the last import, whatever its name, makes import look again.
changed := $(shell find -L "$(capture)" -newer "$(run)/import/manifest.json" -print -quit 2>/dev/null)
all: $(run)/report/manifest.json ## Everything: import, sfm, align, localise, train, fuse, report
$(run)/import/manifest.json: $(settings) $(simulated) $(if $(changed)$(link),FORCE) | $(installed) $(link)
	@$(py) -m groundwalk.capture_import $(arguments)
$(run)/sfm/manifest.json: $(run)/import/manifest.json $(settings)
	@$(py) -m groundwalk.sfm $(arguments)
$(run)/align/manifest.json: $(run)/sfm/manifest.json $(settings)
	@$(py) -m groundwalk.alignment $(arguments)
$(run)/localise/manifest.json: $(run)/align/manifest.json $(settings)
	@$(py) -m groundwalk.localisation $(arguments)
$(run)/train/manifest.json: $(run)/align/manifest.json $(settings) $(predictions)
	@$(py) -m groundwalk.training $(arguments)
else
all:
	@for member in $(members); do $(MAKE) --no-print-directory scene=$$member all; done
	@$(MAKE) --no-print-directory group-report
group-report: $(run)/report/manifest.json
member_manifests := $(foreach member,$(members),data/runs/$(profile)/$(member)/report/manifest.json)
$(run)/train/manifest.json: $(member_manifests) $(settings) $(predictions)
	@$(py) -m groundwalk.training $(arguments)
endif
$(run)/fuse/manifest.json: $(if $(members),,$(run)/localise/manifest.json) $(run)/train/manifest.json $(settings)
	@$(py) -m groundwalk.fusion $(arguments)
$(run)/report/manifest.json: $(run)/fuse/manifest.json $(settings) $(wildcard data/published/*)
	@$(py) -m groundwalk.reports $(arguments)
	@echo "Look at $(run)/report/page.html, or: make scene=$(scene) profile=$(profile) view"

import: $(run)/import/manifest.json ## Stage 1: any capture -> checked frames
sfm: $(run)/sfm/manifest.json ## Stage 2: frames -> COLMAP model
align: $(run)/align/manifest.json ## Stage 3: model and VIO -> metric, gravity-aligned ground truth; drift
localise: $(run)/localise/manifest.json ## Stage 4: maps of points, and the poses that structure localisers give in them
train: $(run)/train/manifest.json ## Stage 5: absolute pose regressors, and their predictions
fuse: $(run)/fuse/manifest.json ## Stage 6: predictions and VIO -> fused poses and errors
report: $(run)/report/manifest.json ## Stage 7: tables, figures, page.html

paper: ## All six scenes in the paper profile (profile=tiny: a rehearsal), then one regressor for all outdoors and one indoors
	@for group in outdoor indoor; do \
		$(MAKE) --no-print-directory scene=$$group profile=$(if $(profile_is_given),$(profile),paper) all \
		|| exit; \
	done

view: | $(installed) ## Open the scene's recordings in the Rerun viewer (web=1: in a browser)
	@$(py) -m groundwalk.artefacts view $(arguments) $(if $(web),--web)

clean: | $(installed) ## Remove the scene's artefacts of this profile and its simulated captures; never a real capture
	@$(py) -m groundwalk.artefacts clean $(arguments)

# ---------------------------------------------------------------- development
check: $(installed) ## Lint, format, types, layering
	@.venv/bin/ruff check --quiet .
	@.venv/bin/ruff format --quiet --check .
	@$(MAKE) --no-print-directory types
	@$(py) -m pytest --quiet tests/test_layering.py

# mypy doesn't follow the path that groundwalk's __init__ sets, so that it gets links laid out as a wheel is.
types: ## Types alone, of whatever is installed in .venv
	@rm -rf build/types && mkdir -p build/types/groundwalk
	@ln -s $(addprefix ../../../,$(wildcard groundwalk/*.py) $(filter-out benchmarks groundwalk,\
		$(patsubst %/__init__.py,%,$(wildcard */__init__.py)))) build/types/groundwalk
	@cd build/types && ../../.venv/bin/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache --no-error-summary

test: $(installed) check ## Checks and tests, under ten minutes on two cores
	@$(py) -m pytest -n 2 -m "not slow"

test-slow: $(installed) ## Whole-pipeline cases
	@$(py) -m pytest -m slow

test-faults: $(installed) ## Damage, kills, full disks, hostile names: a table of faults
	@$(py) -m benchmarks.faults

bench: $(installed) ## Time, memory and bytes of each stage (profile=demo scene=Church unless named)
	@$(py) -m benchmarks.stages --scene "$${scene:-Church}" --profile "$$profile"

bench-localise: $(installed) ## Structure localisers Map and HLoc against the figures to reach (docs/results); finished runs
	@$(py) -m benchmarks.localise

bench-phone: $(installed) ## Exported regressors without PyTorch: bytes, milliseconds, int8 against fp32 (docs/results); a finished run
	@$(py) -m benchmarks.phone --scene "$${scene:-Church}" --profile "$$profile"

bench-training: $(installed) ## Training steps in images a second of a core; official=<folder>: beside MS-Transformer's own code (docs/results)
	@$(py) -m benchmarks.training $(if $(official),--official "$$official")

bench-fusion: $(installed) ## Fusion methods on the same walks, with the figures to reach (build/fusion)
	@$(py) -m benchmarks.fusion $(if $(wildcard build/trained/runs),--data build/trained)

bench-trained: $(installed) ## Train the regressors of bench-fusion's trained walks (build/trained); an hour and a half
	@$(py) -m benchmarks.fusion_trained

bench-groundtruth: $(installed) ## Ground truth: accuracy, honesty, speed beside COLMAP's stock way, growth, real captures; hours
	@$(py) -m benchmarks.groundtruth
	@$(py) -m benchmarks.groundtruth_settings --data build/groundtruth/church
	@$(py) -m benchmarks.gates

bench-real: $(installed) ## Real captures beside stock COLMAP (docs/results); captures=<folder>: yours, too; stability=1: resampled
	@$(py) -m benchmarks.real $(if $(captures),--capture "$(captures)") $(if $(stability),--stability)

bench-cameras: $(installed) ## Simulated phones whose lens, shutter and focus are unknown (docs/results); hours
	@$(py) -m benchmarks.phone_cameras

bench-import: $(installed) ## Import: speed, memory, figures of each format, nerfstudio beside (nerfstudio=<its python>)
	@$(py) -m benchmarks.import_throughput
	@$(py) -m benchmarks.import_formats $(if $(wildcard ../shared),--captures ../shared/captures --trajectories ../shared/trajectories)
	@$(py) -m benchmarks.import_blurring $(if $(wildcard ../shared),--captures ../shared/captures)
	@$(py) -m benchmarks.import_peers $(if $(nerfstudio),--nerfstudio "$$nerfstudio")

fuzz-import: $(installed) ## Fuzz the capture formats for some seconds (seconds=60); needs the extra `fuzz`
	@$(py) -m benchmarks.import_fuzz "$$seconds"

docs: $(installed) ## Write the generated pages of docs/reference: tables, settings, commands, checks
	@$(py) -m groundwalk docs

docs-site: $(installed) ## Build the documentation as a site, strictly, into build/site
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict
	@echo "Look at build/site/index.html"

lock: ## Resolve the dependencies again into constraints.txt (needs uv)
	uv pip compile --universal --extra dev --python-version 3.11 --no-annotate --upgrade pyproject.toml -o constraints.txt

as_names := sed 's:.*/::; s:\.toml$$::' | tr '\n' ' '
help: ## This text
	@echo "make scene=<scene> [profile=demo|standard|paper|tiny] [captures=<folder>] <target>"
	@echo
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14 | sed 's/^/  /'
	@echo
	@echo "scenes that can be simulated:  $$(grep -ls '^can_simulate = true' data/scenes/*.toml | $(as_names))"
	@echo "groups of scenes:              $$(grep -ls '^members = ' data/scenes/*.toml | $(as_names))"
	@echo "your captures:                 $$(ls -q data/captures 2>/dev/null | $(as_names))"
	@for file in data/profiles/*.toml; do \
		printf 'profile %-8s %s\n' "$$(basename $$file .toml):" "$$(sed -n 's/^description = "\(.*\)"/\1/p' $$file)"; done
	@echo
	@echo "your own captures:  make scene=<name> captures=<folder> all"
	@echo "every command:      .venv/bin/groundwalk --help   (.venv/bin/groundwalk sfm --help: one stage's settings)"

.PHONY: FORCE all $(stages) group-report simulate link-captures install paper view clean check types test test-slow bench bench-localise bench-phone bench-training bench-fusion bench-trained bench-groundtruth bench-real bench-cameras bench-import fuzz-import docs docs-site lock help

# make run          sets everything up, then speaks a sample sentence: live in the browser and as a video
# make demo         the same, without a browser; stops after the video (for servers)
# make wheel        builds dist/kouxing-*.whl, which needs no npm
# make test         all tests
# make test-firefox tests lip sync in Firefox, which must be installed
# make quick        the tests to run while editing, under a minute
# make check        style, types and import rules
# make check-wheel  installs the wheel in an empty environment, and runs it
# make lips-demo    writes the page with lip sync in the browser to dist/lips-demo
# make report       measures everything that is out of date, and writes docs/results.md (CLIPS, CORPUS, NATURAL, LANGUAGES, STEPS, QUICK, FRESH)
# make ovrlipsync   writes the C library with OVRLipSync's interface to dist/ovrlipsync
# make lock         updates the locked versions and hashes of all Python packages
#
# test and check run all their stages, report each failure, and then exit with an error.
PYTHON ?= python3
BIN := .venv/bin
PAGE := services/gateway/page
COMPILED := .venv/compiled
HEADS := $(PAGE)/head.glb
HEAD_SOURCES := $(wildcard services/driver/head/assets/* services/driver/head/*.py) \
	services/driver/render/shaders.py
# The modules that the page loads, and their licenses; make check-wheel finds missing ones.
PAGE_MODULES := three/LICENSE three/build/three.core.js three/build/three.module.js \
	three/examples/jsm/controls/OrbitControls.js three/examples/jsm/loaders/GLTFLoader.js \
	three/examples/jsm/utils/BufferGeometryUtils.js three/examples/jsm/utils/SkeletonUtils.js \
	@mediapipe/face_mesh
MOS := evaluation/mos/page
NODE_EXAMPLE := examples/node
JAVASCRIPT := clients/javascript
LIPS := clients/kouxing-lips
LIPS_MODELS := $(LIPS)/models/model.json
RIVALS := evaluation/rivals
OVRLIPSYNC := clients/ovrlipsync
AVATAR := examples/browser-vrm
BLENDER := examples/blender/.venv
BLENDER_LOCK := examples/blender/requirements.lock
SAMPLE := shared/demo/hello-female.wav
# pip installs only packages with these hashes. The dev lock lacks torch: the CPU build has other hashes.
LOCK := requirements.lock
LOCK_DEV := requirements-dev.lock
LOCK_TORCH := requirements-torch.lock
LOCK_TORCH_CPU := requirements-torch-cpu.lock
TORCH := torch==2.13.0
TORCH_CPU := --index-url https://download.pytorch.org/whl/cpu --retries 0 --timeout 10
RIVAL_PACKAGES := hama==1.7.0 pylipsync==0.2.1 openfacefx==0.24.0
BPY := bpy==4.5.15
INSTALL := -m pip install --quiet
PIP := $(BIN)/python $(INSTALL)
PIP_LOCK := $(PIP) --require-hashes --requirement
NPM := PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/npm --no-audit --no-fund --loglevel=error --prefix
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# The tests start hundreds of Python processes; with bytecode files, only the first ones compile the modules.
unexport PYTHONDONTWRITEBYTECODE

TEST_STAGES := test-python test-page test-lips
CHECK_STAGES := $(addprefix check-,ruff format types imports godot page mos javascript compose docker)
STAGES = $(MAKE) --keep-going --no-print-directory
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: run demo setup wheel test quick blender check check-wheel lips-demo ovrlipsync report test-firefox lock clean $(TEST_STAGES) $(CHECK_STAGES)

run: setup
	$(BIN)/kouxing run --play $(SAMPLE)

demo: setup
	$(BIN)/kouxing run --play $(SAMPLE) --stop-after

setup: .venv/installed $(PAGE)/node_modules/.package-lock.json $(HEADS)

# The page's modules are in the package only while the wheel is built.
wheel: .venv/installed $(PAGE)/node_modules/.package-lock.json
	rm -rf build dist $(PAGE)/vendor
	mkdir $(PAGE)/vendor
	tar -C $(PAGE)/node_modules -cf - $(PAGE_MODULES) | tar -C $(PAGE)/vendor -xf -
	$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .; status=$$?; \
		rm -rf build $(PAGE)/vendor; exit $$status
	ls -l dist

test: .venv/installed-dev setup $(COMPILED) $(LIPS_MODELS) \
		$(patsubst %,%/node_modules/.package-lock.json,$(NODE_EXAMPLE) $(JAVASCRIPT) $(LIPS) $(AVATAR))
	$(STAGES) $(TEST_STAGES)

test-python:
	$(PYTEST) -n 3 --dist loadfile --no-loadscope-reorder

test-page:
	$(NPM) $(PAGE) test

test-lips:
	$(NPM) $(LIPS) test

# Needs the package firefox-esr, which the other tests do not need.
test-firefox: .venv/installed-dev
	$(PYTEST) -q -s tests/e2e/firefox_lips_page.py

quick: .venv/installed-dev
	$(PYTEST) -q -n auto --maxprocesses 4 -m "(unit or property or contract) and not slow"

blender: $(BLENDER)/installed

check: .venv/installed-dev $(PAGE)/node_modules/.bin/eslint
	$(STAGES) $(CHECK_STAGES)

check-ruff:
	$(BIN)/ruff check .

check-format:
	$(BIN)/ruff format --check .

check-types:
	$(BIN)/mypy

check-imports:
	$(BIN)/lint-imports

check-godot:
	$(BIN)/gdlint examples/godot/*.gd
	$(BIN)/gdformat --check --diff examples/godot/*.gd

check-page:
	$(NPM) $(PAGE) run lint

check-mos:
	cd $(MOS) && PATH="$(CURDIR)/$(BIN):$$PATH" $(CURDIR)/$(PAGE)/node_modules/.bin/eslint --max-warnings 0 -c $(CURDIR)/$(PAGE)/eslint.config.mjs .

check-javascript:
	$(NPM) $(JAVASCRIPT) run lint
	$(NPM) $(LIPS) run lint
	$(NPM) $(RIVALS) run lint

check-compose:
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml

check-docker:
	$(BIN)/hadolint deploy/Dockerfile

check-wheel: wheel
	$(PYTHON) deploy/check_wheel.py dist/kouxing-*.whl

lips-demo: setup $(LIPS_MODELS) $(patsubst %,%/node_modules/.package-lock.json,$(JAVASCRIPT) $(LIPS))
	$(BIN)/node $(LIPS)/demo/build.mjs dist/lips-demo

# CLIPS, CORPUS, NATURAL and LANGUAGES are folders of recordings. STEPS names steps; QUICK=1 and FRESH=1 are options.
report: .venv/installed-dev setup $(LIPS_MODELS) $(RIVALS)/.venv/installed \
		$(patsubst %,%/node_modules/.package-lock.json,$(RIVALS) $(LIPS))
	$(BIN)/kouxing evaluate report $(STEPS) $(CLIPS:%=--clips %) $(CORPUS:%=--corpus %) $(NATURAL:%=--conversation %) \
		$(LANGUAGES:%=--languages %) $(QUICK:1=--quick) $(FRESH:1=--fresh)

ovrlipsync: setup $(LIPS_MODELS)
	rm -rf dist/ovrlipsync
	mkdir -p dist/ovrlipsync
	cp $(OVRLIPSYNC)/*.c $(OVRLIPSYNC)/*.h $(OVRLIPSYNC)/CMakeLists.txt dist/ovrlipsync
	$(BIN)/node $(OVRLIPSYNC)/model.mjs $(LIPS)/models dist/ovrlipsync

# The locks suit every system and Python >= 3.11. The version of torch is fixed: training depends on it.
# When it changes, copy the hashes of its CPU builds from the index of TORCH_CPU to LOCK_TORCH_CPU.
COMPILE := $(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes \
	--no-annotate --custom-compile-command 'make lock'
BUILD_REQUIRES := sed -n 's/^requires = \["\(.*\)"\]/\1/p' pyproject.toml
WITHOUT_TORCH := sed -n -E 's/^((torch|triton|cuda-|nvidia-)[^=]*)==.*/--no-emit-package \1/p' $(LOCK_TORCH)

lock: .venv/installed-dev
	echo '$(TORCH)' | $(COMPILE) --output-file $(LOCK_TORCH) -
	$(BUILD_REQUIRES) | $(COMPILE) --all-extras --constraint $(LOCK_TORCH) $$($(WITHOUT_TORCH)) \
		--output-file $(LOCK_DEV) pyproject.toml -
	$(BUILD_REQUIRES) | $(COMPILE) --extra page --constraint $(LOCK_DEV) --output-file $(LOCK) pyproject.toml -
	echo '$(BPY)' | $(COMPILE) --output-file $(BLENDER_LOCK) -
	printf '%s\n' $(RIVAL_PACKAGES) | $(COMPILE) --output-file $(RIVALS)/requirements.lock -

clean:
	rm -rf .venv $(BLENDER) $(PAGE)/node_modules $(NODE_EXAMPLE)/node_modules \
		$(JAVASCRIPT)/node_modules $(LIPS)/node_modules $(LIPS)/models $(AVATAR)/node_modules \
		$(RIVALS)/node_modules $(RIVALS)/.venv \
		$(PAGE)/head*.glb build dist out

.venv/installed: pyproject.toml $(LOCK) deploy/system_packages.sh
	sh deploy/system_packages.sh run
	$(PYTHON) -m venv .venv
	$(PIP_LOCK) $(LOCK)
	$(PIP) --no-deps --no-build-isolation --editable .
	touch $@

.venv/installed-dev: .venv/installed $(LOCK_DEV) $(LOCK_TORCH) $(LOCK_TORCH_CPU)
	sh deploy/system_packages.sh test
	$(PIP_LOCK) $(LOCK_TORCH_CPU) --no-deps $(TORCH_CPU) || $(PIP_LOCK) $(LOCK_TORCH)
	$(PIP_LOCK) $(LOCK_DEV)
	touch $@

$(PAGE)/node_modules/.package-lock.json: $(PAGE)/package-lock.json | .venv/installed
	$(NPM) $(PAGE) ci --omit=dev
	touch $@

$(PAGE)/node_modules/.bin/eslint: $(PAGE)/package-lock.json | .venv/installed
	$(NPM) $(PAGE) ci
	touch $@ $(PAGE)/node_modules/.package-lock.json

$(patsubst %,%/node_modules/.package-lock.json,$(NODE_EXAMPLE) $(JAVASCRIPT) $(LIPS) $(AVATAR) $(RIVALS)): \
		%/node_modules/.package-lock.json: %/package-lock.json | .venv/installed
	$(NPM) $* ci
	touch $@

$(RIVALS)/.venv/installed: $(RIVALS)/requirements.lock
	$(PYTHON) -m venv $(RIVALS)/.venv
	$(RIVALS)/.venv/bin/python $(INSTALL) --require-hashes --requirement $<
	touch $@

# Blender needs Python 3.11 and an older numpy. Without it, its test is skipped.
$(BLENDER)/installed: $(BLENDER_LOCK)
	$(PYTHON) -m venv $(BLENDER)
	$(BLENDER)/bin/python $(INSTALL) --require-hashes --requirement $(BLENDER_LOCK)
	touch $@

# Fills Numba's cache. Otherwise all services that start at the same time compile the same functions.
$(COMPILED): $(wildcard services/recognizer/front_end/*.py services/recognizer/search/*.py) | .venv/installed
	$(BIN)/python -c "from kouxing.services.recognizer.acoustic.load import load_model; \
		from kouxing.services.recognizer.live.recognizer import Recognizer; Recognizer(load_model()).warm_up()"
	touch $@

$(HEADS): $(HEAD_SOURCES) | .venv/installed
	$(BIN)/kouxing head export --force $(PAGE)

$(LIPS_MODELS): services/cli/web_model.py $(wildcard services/recognizer/models/*.npz \
		services/recognizer/*.py services/recognizer/*/*.py services/synthesizer/*.py \
		services/synthesizer/modifiers/*.py services/synthesizer/lips/learned/*.py shared/face/*) | .venv/installed
	$(BIN)/kouxing export web --force $(LIPS)/models

# make run    sets everything up, then a sample sentence drives the face, live in the browser and as a video
# make demo   the same up to the video, then stops (for servers)
# make test   all tests           make quick  those to run while editing, under a minute
# make check  style, types and import rules
# make lock   renews the locked versions of all Python packages
PYTHON ?= python3
BIN := .venv/bin
PAGE := services/gateway/page
HEADS := $(PAGE)/head.glb $(patsubst %,$(PAGE)/head-%.glb,man elder child ada leo rosa mika)
EXPORT := services/driver/head/glb_export.py services/driver/render/shaders.py
MOS := evaluation/mos/page
CLIENT := proto/node
JAVASCRIPT := clients/javascript
AVATAR := examples/browser-vrm
BLENDER := examples/blender/.venv
SAMPLE := shared/demo/hello-female.wav
LOCK := requirements.lock
TORCH := torch==2.13.0
TORCH_CPU := --index-url https://download.pytorch.org/whl/cpu --retries 0 --timeout 10
PIP := $(BIN)/python -m pip install --quiet
NPM := PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/npm --no-audit --no-fund --loglevel=error --prefix
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: run demo setup test quick blender check lock clean

run: setup
	$(BIN)/kouxing run --play $(SAMPLE)

demo: setup
	$(BIN)/kouxing run --play $(SAMPLE) --stop-after

setup: .venv/installed $(PAGE)/node_modules/.package-lock.json $(HEADS)

# Two processes begin with the tests that start services, a third with the others.
test: .venv/installed-dev setup $(patsubst %,%/node_modules/.package-lock.json,$(CLIENT) $(JAVASCRIPT) $(AVATAR))
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile -m "not alone"
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m alone
	$(NPM) $(PAGE) test

quick: .venv/installed-dev
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 4 \
		-m "(unit or property or contract) and not slow"

blender: $(BLENDER)/installed

check: .venv/installed-dev $(PAGE)/node_modules/.bin/eslint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/gdlint examples/godot/*.gd
	$(BIN)/gdformat --check --diff examples/godot/*.gd
	$(NPM) $(PAGE) run lint
	cd $(MOS) && PATH="$(CURDIR)/$(BIN):$$PATH" $(CURDIR)/$(PAGE)/node_modules/.bin/eslint --max-warnings 0 -c $(CURDIR)/$(PAGE)/eslint.config.mjs .
	$(NPM) $(JAVASCRIPT) run lint
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml
	$(BIN)/hadolint deploy/Dockerfile

# One lock for every system and Python >= 3.11; torch keeps its version, which training depends on.
lock: .venv/installed
	$(PIP) uv
	echo '$(TORCH)' | $(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --all-extras \
		--no-annotate --custom-compile-command 'make lock' --output-file $(LOCK) pyproject.toml -

clean:
	rm -rf .venv $(BLENDER) $(PAGE)/node_modules $(CLIENT)/node_modules \
		$(JAVASCRIPT)/node_modules $(AVATAR)/node_modules $(HEADS) out

.venv/installed: pyproject.toml $(LOCK) deploy/system_packages.sh
	sh deploy/system_packages.sh run
	$(PYTHON) -m venv .venv
	$(PIP) --constraint $(LOCK) --editable '.[page]'
	touch $@

.venv/installed-dev: .venv/installed
	sh deploy/system_packages.sh test
	$(PIP) $(TORCH_CPU) $(TORCH) || $(PIP) $(TORCH)
	$(PIP) --constraint $(LOCK) --editable '.[page,dev,neural-training]'
	touch $@

$(PAGE)/node_modules/.package-lock.json: $(PAGE)/package-lock.json | .venv/installed
	$(NPM) $(PAGE) ci --omit=dev
	touch $@

$(PAGE)/node_modules/.bin/eslint: $(PAGE)/package-lock.json | .venv/installed
	$(NPM) $(PAGE) ci
	touch $@ $(PAGE)/node_modules/.package-lock.json

$(patsubst %,%/node_modules/.package-lock.json,$(CLIENT) $(JAVASCRIPT) $(AVATAR)): \
		%/node_modules/.package-lock.json: %/package-lock.json | .venv/installed
	$(NPM) $* ci
	touch $@

# Blender wants Python 3.11 and an older numpy; its test is left out where it is not installed.
$(BLENDER)/installed:
	$(PYTHON) -m venv $(BLENDER)
	$(BLENDER)/bin/python -m pip install --quiet bpy==4.5.15
	touch $@

$(PAGE)/head.glb: $(wildcard services/driver/head/assets/*) $(EXPORT) | .venv/installed
	$(BIN)/kouxing head export $@

$(PAGE)/head-%.glb: services/driver/head/assets/%.npz $(EXPORT) | .venv/installed
	$(BIN)/kouxing head export --head $* $@

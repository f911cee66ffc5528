# make run   sets everything up, then a sample sentence drives the face, live in the browser and as a video
# make demo  the same up to the video, then stops (for servers)
# make test  the tests            make check  style, types and import rules
PYTHON ?= python3
BIN := .venv/bin
PAGE := services/gateway/page
SAMPLE := shared/demo/hello-female.wav
TORCH := torch==2.13.0
TORCH_CPU := --index-url https://download.pytorch.org/whl/cpu --retries 0 --timeout 10
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: run demo setup test check clean

run: setup
	$(BIN)/kouxing run --play $(SAMPLE)

demo: setup
	$(BIN)/kouxing run --play $(SAMPLE) --stop-after

setup: .venv/installed $(PAGE)/node_modules/.package-lock.json $(PAGE)/head.glb

test: .venv/installed-dev setup
	$(BIN)/python -m pytest

check: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml

clean:
	rm -rf .venv $(PAGE)/node_modules $(PAGE)/head.glb out

.venv/installed: pyproject.toml deploy/system_packages.sh
	sh deploy/system_packages.sh run
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[page]'
	touch $@

.venv/installed-dev: .venv/installed
	sh deploy/system_packages.sh test
	$(BIN)/python -m pip install --quiet $(TORCH_CPU) $(TORCH) || $(BIN)/python -m pip install --quiet $(TORCH)
	$(BIN)/python -m pip install --quiet --editable '.[page,dev,neural-training]'
	touch $@

$(PAGE)/node_modules/.package-lock.json: $(PAGE)/package-lock.json | .venv/installed
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/npm ci --prefix $(PAGE) --no-audit --no-fund --loglevel=error
	touch $@

$(PAGE)/head.glb: $(wildcard services/driver/assets/*) services/driver/glb.py | .venv/installed
	$(BIN)/kouxing head export $@

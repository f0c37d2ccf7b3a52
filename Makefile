# The two commands: `make notebooks` and `make test`. Python 3.11+ and make are all they need.
PYTHON ?= python3
ifeq ($(CONDA_DEFAULT_ENV),motionlab)
VENV ?= $(CONDA_PREFIX)
endif
VENV ?= .venv
PY := $(VENV)/bin/python
INSTALLED := $(VENV)/.motionlab-installed
PREPARED := $(VENV)/.motionlab-prepared
INTEROP := .venv-interop
THREE := three@0.180.0
WHOLE_NAMES := {"@jupyterlab/filebrowser-extension:browser": {"showLastModifiedColumn": false, "showFileSizeColumn": false}}
PIP := $(PY) -m pip --disable-pip-version-check install -c constraints.txt

.PHONY: notebooks test interop lab full records small train bench doctor setup pins clean
.DEFAULT_GOAL := help

help:
	@echo "make notebooks   set up, run the notebooks, write report/index.html (MOTIONLAB_PROFILE=full for the long version)"
	@echo "make test        set up, lint, unit tests, notebooks checked by nbval"
	@echo "make interop     set up, open our files in Blender, three.js, aitviewer and ffprobe, find keypoints by rtmlib (3.5 GB more)"
	@echo "make lab         set up, open copies of the notebooks (lab/) in JupyterLab with interactive 3-D, short runs"
	@echo "make full        regenerate the committed notebooks and results"
	@echo "make records     what notebooks 08 and 14 read and takes hours: what is on record of this recipe is kept"
	@echo "make small       the small models that notebooks 10, 13 and 15 compare, from MOTIONLAB_DATA (hours): rows are kept"
	@echo "make train       pose prior, first states and features of recordings, in MOTIONLAB_DATA (hours)"
	@echo "make bench       speed as ratios of one run; of fits and fills also where they end"
	@echo "make doctor      what is installed, what is missing, and the remedy; how large each room is"

notebooks: setup
	@PYTHONPATH=notebooks $(PY) -m suite report

test: setup
	@$(PY) tests/run.py

interop: setup $(INTEROP)/.installed $(INTEROP)/.detect
	@mkdir -p report/interop
	@MOTIONLAB_DETECT=1 PYTHONPATH=$(INTEROP)/detect $(PY) -m pytest -q -rs -p no:nbval tests/test_detect.py
	@MOTIONLAB_INTEROP=$(INTEROP)/bin/python MOTIONLAB_THREE=$(INTEROP)/package MOTIONLAB_INTEROP_OUT=report/interop \
		$(PY) -m pytest -q -rs -p no:nbval tests/interop

lab: setup
	@PYTHONPATH=notebooks $(PY) -m suite.copies lab
	@mkdir -p lab/.settings && echo '$(WHOLE_NAMES)' > lab/.settings/overrides.json
	@PYTHONPATH=$(CURDIR)/notebooks MOTIONLAB_PROFILE=$${MOTIONLAB_PROFILE:-smoke} \
		PYVISTA_JUPYTER_BACKEND=trame PYVISTA_TRAME_SERVER_PROXY_PREFIX=/proxy/ $(PY) -m jupyterlab --notebook-dir=lab \
		--LabApp.app_settings_dir=$(CURDIR)/lab/.settings --ContentsManager.hide_globs='["claims.toml","results","__pycache__"]' \
		$$(test $$(id -u) = 0 && echo --allow-root) $(LAB_FLAGS) lab/00_start_here.ipynb

full: setup
	@PYTHONPATH=notebooks $(PY) -m suite regenerate $(NOTEBOOKS)

records: setup
	@PYTHONPATH=notebooks OMP_NUM_THREADS=1 $(PY) -m studies.nb08_fast.official_schedule notebooks/results/long/faithful.json
	@test -z "$$MOTIONLAB_DATA" || PYTHONPATH=notebooks OMP_NUM_THREADS=1 nice -n 19 $(PY) -m studies.nb14_handles.make_record notebooks/results/long/handles.json

small: setup
	@test -n "$$MOTIONLAB_DATA" || { echo "name a folder of recordings: make small MOTIONLAB_DATA=FOLDER"; exit 2; }
	@PYTHONPATH=notebooks OMP_NUM_THREADS=1 $(PY) -m studies.shared.small_models $${SETS:-frames losses people stop noising longer}
	@PYTHONPATH=notebooks OMP_NUM_THREADS=1 $(PY) -m studies.nb13_worlds.films

train: setup
	@test -n "$$MOTIONLAB_DATA" || { echo "name a folder of recordings: make train MOTIONLAB_DATA=FOLDER"; exit 2; }
	@$(PY) -m motionlab train small --data "$$MOTIONLAB_DATA"
	@PYTHONPATH=notebooks $(PY) -m studies.shared.feature_training "$$MOTIONLAB_DATA"

bench: setup
	@$(PY) tests/bench/run.py

doctor: setup
	@$(PY) -m motionlab doctor
	@$(PY) tests/sizes.py

setup: $(PREPARED)
	@:

$(PREPARED): $(INSTALLED) motionlab/body.py motionlab/commands/doctor.py
	@echo "== preparing: off-screen rendering and the body"
	@$(PY) -m motionlab doctor --prepare
	@$(PY) -m jupyter labextension disable --level=sys_prefix @jupyterlab/apputils-extension:announcements
	@touch $@

$(INSTALLED): constraints.txt pyproject.toml | $(PY)
	@echo "== installing the pinned packages into $(VENV) (minutes the first time)"
	@$(PIP) $(shell grep '^torch==' constraints.txt)
	@$(PIP) -e '.[dev]'
	@touch $@

$(PY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "motionlab needs Python 3.11 or newer, '$(PYTHON)' is not: make PYTHON=/path/to/python3.12 ..."; exit 1; }
	@echo "== making $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); echo "no venv in this Python; on Debian/Ubuntu: apt-get install -y python3-venv"; exit 1; }

# Other programs, in an environment of their own: what they need (an older trimesh) is not what we need.
$(INTEROP)/.installed: tests/interop/requirements.txt
	@python3.11 -c 'import venv' || { echo "Blender as a module needs python3.11 on the path"; exit 1; }
	@echo "== installing other programs into $(INTEROP) (minutes the first time)"
	@python3.11 -m venv $(INTEROP)
	@$(INTEROP)/bin/python -m pip --disable-pip-version-check install -r tests/interop/requirements.txt
	@if command -v npm > /dev/null; then cd $(INTEROP) && npm pack --silent $(THREE) && tar xzf three-*.tgz; \
		else echo "no npm: three.js will be skipped"; fi
	@touch $@

# The extra `detect`, for our own Python, in a folder of its own: the pinned packages stay as they are.
$(INTEROP)/.detect: tests/interop/detect.txt $(INSTALLED) | $(INTEROP)/.installed
	@echo "== installing rtmlib and onnxruntime into $(INTEROP)/detect"
	@rm -rf $(INTEROP)/detect
	@$(PIP) --no-deps --target $(INTEROP)/detect -r tests/interop/detect.txt
	@touch $@

pins: setup
	@$(PY) tests/pins.py

clean:
	rm -rf .venv $(INTEROP) .cache report build *.egg-info

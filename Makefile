# make run [SECONDS=20] · make test · make help. Everything is installed into .venv, nothing outside this folder.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet
FOLDERS := daemon drivers calib sim bench

.PHONY: help run test check config dist deb wheels test-robot test-deb clean
.PHONY: bench-fusion soak bench-wires bench-pages bench-faults bench-cross-checks bench-refine bench-fleet bench-place bench-latency bench-starved kill-test damage-matrix fuzz
.PHONY: bench-wizard bench-vision bench-frame-cost bench-real bench-paper bench-mrclam bench-filter bench-find-place bench-gaps bench-calib bench-arm
.DEFAULT_GOAL := help

help:
	@echo "make run [SECONDS=n]   a simulated robot localises itself; ends by itself after n seconds; TILT=1: rocks by 1 deg"
	@echo "make test              every check and every test that needs no special rights"
	@echo "make check             format, lint and types only"
	@echo "make test-robot        the installed service on a virtual robot (needs root, apt and a compiler)"
	@echo "make bench-vision      the front end against exact truth, a lap each condition (QUICK=1: seconds each; DRAWN=24: random ones): SEED=1"
	@echo "make bench-frame-cost  time of a frame over bare Canny, looked at near predicted edges and whole: OFFICE=folder"
	@echo "make bench-real DATA=d recordings of real ceilings in folder d"
	@echo "make bench-paper       the paper's experiment against rivals: SEEDS=100 JOBS=1; resumable"
	@echo "make bench-mrclam      filters on recorded robots: DATA=folder, else CEILVO_DATA; resumable"
	@echo "make bench-filter      time of a filter's step, as ratios"
	@echo "make bench-find-place time, memory and answers of the place index on halls of 150 m"
	@echo "make bench-gaps        what odometry claims after gaps against the truth: SEED=901"
	@echo "make bench-calib       commissioning over 50 simulated rigs, 8 driven, 400 noise experiments; resumable"
	@echo "make bench-wizard      commissioning in Chromium, phone and laptop, from nothing to TRACKING, timed step by step"
	@echo "make soak              the daemon with faults and floods for hours: HOURS=1; verdict, plot and JSON in build/bench/"
	@echo "make bench-faults      wrong poses called good, right ones lost: HOURS=10 of laps with faults, carried robots too; resumable"
	@echo "make bench-cross-checks  what picture, wheels and stamps say against each other: HOURS=1 without a fault, COUNT=20 of each"
	@echo "make bench-refine      maps of buildings before and after refinement"
	@echo "make bench-fleet       50 robots, 15 of them lie, one map service killed 10 times: what is lost, bytes; ROBOTS=50"
	@echo "make bench-place       faults of place in rooms and halls: COUNT=300 HOURS=10 SEED=1000; resumable"
	@echo "make bench-fusion      what wheels, gyro and other senses give, and whether any hurts: SEEDS=4 JOBS=1; resumable"
	@echo "make bench-arm         installs ceilvo on an emulated 64-bit ARM and compares every pose (root)"
	@echo "make bench-latency     from the exposure to Zenoh and to the base's register, in real time: SECONDS=60"
	@echo "make bench-wires       what ROS 2 programs get, what all wires cost, routers killed: SECONDS=30"
	@echo "make bench-pages       the estimator with three pages open in Chromium and with none, paired: PAIRS=8"
	@echo "make bench-starved     one core, hogs on it, cameras of 2 to 90 Hz: states, ages, the rate that is used"
	@echo "make kill-test         kill -9 while it saves, and of the whole daemon while it drives, KILLS=200 times each"
	@echo "make damage-matrix     every file that it reads or keeps, damaged in every way, then a run: 1200 cases"
	@echo "make fuzz              every reader of bytes, MINUTES=10 each; by coverage where atheris can be installed"
	@echo "make deb               Debian package of the whole program in dist/ (root or fakeroot)"
	@echo "make test-deb          the package installed, tracking, upgraded, removed and purged on the virtual robot; lintian"
	@echo "make wheels            the wheel with the compiled kernel for any Linux of this processor in dist/ (auditwheel)"
	@echo "make dist              wheel and source archive in dist/"
	@echo "make config            write config.yaml anew from the schema in ceilvo/config/schema.py"
	@echo "make clean             remove build/, dist/ and caches; .venv stays"

run: $(VENV)/.installed
	@$(BIN)/ceilvod run --simulate $(if $(SECONDS),--seconds $(SECONDS)) $(if $(TILT),--tilt-deg $(TILT))

# Processes that tests start compile every source again where bytecode is not kept.
test: export PYTHONDONTWRITEBYTECODE =
test: check
	$(BIN)/python -m pytest --numprocesses 3 --dist worksteal

check: export MYPY_NUM_WORKERS = 2
check: $(VENV)/.installed-dev
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	@rm -rf build/site && mkdir -p build/site && cp -r ceilvo build/site/ && cp -r $(FOLDERS) build/site/ceilvo/
	MYPYPATH=build/site $(BIN)/mypy -p ceilvo
	MYPYPATH=build/site $(BIN)/mypy tests/structure/swapped_types.py packaging/manual.py docs/images/setup.py

config: $(VENV)/.installed
	$(BIN)/python -m ceilvo.config.rendering > config.yaml.new && mv config.yaml.new config.yaml

dist: $(VENV)/.installed-dev
	$(BIN)/python -m build --outdir dist .

bench-paper: $(VENV)/.installed-bench
	$(BIN)/python -m ceilvo.bench.paper --seeds $(or $(SEEDS),100) --jobs $(or $(JOBS),1)

bench-mrclam: $(VENV)/.installed-bench
	$(BIN)/python -m ceilvo.bench.mrclam $(DATA) --jobs $(or $(JOBS),1)

bench-filter: $(VENV)/.installed-bench
	$(BIN)/python -m ceilvo.bench.speed.filter_step

bench-gaps: $(VENV)/.installed-bench
	$(BIN)/python -m ceilvo.bench.gaps --seed $(or $(SEED),901)

bench-find-place: $(VENV)/.installed-bench
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.speed.find_place

bench-wizard: $(VENV)/.installed-dev
	WIZARD_SIZES=phone,laptop $(BIN)/python -m pytest -s tests/daemon/app/test_wizard_page.py

bench-calib: $(VENV)/.installed
	$(BIN)/python -m ceilvo.calib.study sigma --count 100
	$(BIN)/python -m ceilvo.calib.study drive --count 8
	$(BIN)/python -m ceilvo.calib.study rigs --count 50
	$(BIN)/python -m ceilvo.calib.study scale --count 40

soak: $(VENV)/.installed-bench
	$(BIN)/python -m ceilvo.bench.soak --hours $(or $(HOURS),1)

bench-faults: $(VENV)/.installed
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.faults --carried --hours $(or $(HOURS),10) --resume

bench-cross-checks: $(VENV)/.installed
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.cross_checks hours --hours $(or $(HOURS),1) --seed $(or $(SEED),1)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.cross_checks faults --count $(or $(COUNT),20) --seed $(or $(SEED),1)

bench-refine: $(VENV)/.installed-bench
	$(BIN)/python -m ceilvo.bench.refine

bench-fleet: $(VENV)/.installed-dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.fleet --robots $(or $(ROBOTS),50) --kills $(or $(KILLS),10)

bench-place: $(VENV)/.installed-dev
	$(BIN)/python -m ceilvo.bench.place faults --count $(or $(COUNT),300) --seed $(or $(SEED),1000) --resume
	$(BIN)/python -m ceilvo.bench.place laps --hours $(or $(HOURS),10) --seed $(or $(SEED),1000) --resume
	$(BIN)/python -m ceilvo.bench.place carried --seed $(or $(SEED),1000) --resume
	$(BIN)/python -m ceilvo.bench.place restart --seed $(or $(SEED),1000) --resume
	$(BIN)/python -m ceilvo.bench.place renovated --seed $(or $(SEED),1000) --resume
	$(BIN)/python -m ceilvo.bench.place heights --seed $(or $(SEED),1000) --resume
	$(BIN)/python -m ceilvo.bench.place start --seed $(or $(SEED),1000) --resume
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.place steps --seed $(or $(SEED),1000)
	REGRESSIONS=all $(BIN)/python -m pytest tests/bench/test_place_regressions.py

bench-fusion: $(VENV)/.installed-bench
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.fusion --seeds $(or $(SEEDS),4) --jobs $(or $(JOBS),1)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.fusion.motion --count $(or $(COUNT),20) --jobs $(or $(JOBS),1)

bench-arm: $(VENV)/.installed
	bash bench/arm/emulated.sh

bench-latency: $(VENV)/.installed
	$(BIN)/python -m ceilvo.bench.speed.latency --seconds $(or $(SECONDS),60)

bench-wires: $(VENV)/.installed-dev
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.wires --seconds $(or $(SECONDS),30)

bench-pages: $(VENV)/.installed-bench
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m ceilvo.bench.speed.pages --pairs $(or $(PAIRS),8)

bench-starved: $(VENV)/.installed
	$(BIN)/python -m ceilvo.bench.starved --seconds $(or $(SECONDS),20)

kill-test: $(VENV)/.installed-dev
	KILLS=$(or $(KILLS),200) $(BIN)/python -m pytest tests/faults/test_files.py tests/faults/test_kill.py tests/daemon/map/database tests/daemon/fleet -k killed -q -s

damage-matrix: $(VENV)/.installed-dev
	DAMAGES=all $(BIN)/python -m pytest tests/faults/test_damage_matrix.py -q -s

fuzz: $(VENV)/.installed-dev
	@$(PIP) -e '.[fuzz]' -c constraints.txt || echo "atheris cannot be installed here: mutations at random instead"
	$(BIN)/python -m ceilvo.bench.fuzz --minutes $(or $(MINUTES),10)

test-robot:
	bash tests/robot/run.sh

deb: $(VENV)/.installed
	bash packaging/deb/build.sh

test-deb: $(VENV)/.installed
	ONLY=deb DRIVE_S=12 bash tests/robot/run.sh

wheels: $(VENV)/.installed
	bash packaging/wheels.sh dist

bench-vision: $(VENV)/.installed-dev
	@$(BIN)/python -m ceilvo.bench.vision $(if $(QUICK),--quick) $(if $(CONDITIONS),--conditions $(CONDITIONS)) $(if $(DRAWN),--drawn $(DRAWN)) $(if $(SEED),--seed $(SEED))

bench-frame-cost: $(VENV)/.installed-dev
	@$(BIN)/python -m ceilvo.bench.speed.frame_cost --look both $(if $(OFFICE),--office $(OFFICE))

bench-real: $(VENV)/.installed-dev
	@$(BIN)/python -m ceilvo.bench.real $(or $(DATA),../shared/data)

clean:
	rm -rf build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || { \
	  echo "make: $(PYTHON) is $$($(PYTHON) --version 2>/dev/null || echo missing), expected Python 3.10 or newer;" \
	    "install one and run: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "make: $(PYTHON) cannot make virtual environments; run: apt install python3-venv" >&2; exit 1; }
	@echo "making $(VENV)"
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml setup.py constraints.txt $(wildcard daemon/*/kernel/*.pyx) | $(BIN)/pip
	@echo "installing ceilvo into $(VENV) (first time: about a minute)"
	@$(PIP) -e . -c constraints.txt
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "installing what the checks need into $(VENV)"
	@$(PIP) -e '.[dev]' -c constraints.txt
	@touch $@

# The peers' libraries are extras: where one cannot be installed the benches run without it and say so.
$(VENV)/.installed-bench: $(VENV)/.installed
	@echo "installing what the benches compare with into $(VENV)"
	@$(PIP) -e '.[bench]' -c constraints.txt || $(PIP) matplotlib -c constraints.txt
	@touch $@

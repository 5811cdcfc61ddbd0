#!/usr/bin/env bash
# run.sh FOLDER -- the tests of what needs neither torch, Ray, MLflow nor PyBullet, on the Python 3.13 that install.sh left.
# That Python has a loader of its own, without which no test can start another.
set -euo pipefail
folder=$(cd "$1" && pwd)
cd "$(dirname "$0")/../.."
PYTHONPATH=$PWD:$folder/libraries exec "$folder/python" -m pytest -q -p no:cacheprovider \
  -k 'not AntGoal and not BallCatching and not another_process' \
  tests/test_config.py tests/test_config_faults.py tests/test_identity.py tests/test_instances.py tests/test_curricula.py \
  tests/test_pointmass.py tests/test_cartpole.py tests/test_curriculum_checker.py tests/test_env_checker.py

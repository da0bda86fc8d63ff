#!/usr/bin/env bash
# Tries the package with every Python 3.10 to 3.13 on this machine: once with the lowest versions that
# pyproject.toml allows, once with the newest, each in an environment that is thrown away.
#
#     test/matrix.sh            all of them
#     test/matrix.sh 3.11       some of them
#
# PyBullet has wheels for 3.11 only and compiles for minutes elsewhere: without SIM=1 the other Pythons
# go without it, and replay a walk instead of training.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
PURE="test/test_params.py test/test_params_files.py test/test_kinematics.py test/test_gait.py
  test/test_policy.py test/test_discretizer.py test/test_shipped.py test/test_entry_points.py"
SHOWN="numpy click rich matplotlib pyyaml pybullet rosbags mcap scipy pytest hypothesis"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export ROS_LOG_DIR=$work/log ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}

# try PYTHON VERSION RESOLUTION: one environment, from installing to the last test.
try() {
  local env="$work/$2-$3" code=0 extras=ros,bags,science,test
  if [ "$2" = 3.11 ] || [ -n "${SIM:-}" ]; then extras=$extras,sim; fi
  "$1" -m venv "$env"
  "$env/bin/python" -m pip install --quiet uv
  : >"$work/build.txt"
  if [ "$3" = lowest-direct ]; then  # of what pip builds the package with, too
    sed -n 's/^requires = \["\(.*\)>=\(.*\)"\]$/\1==\2/p' pyproject.toml >"$work/build.txt"
  fi
  # A lowest version is one with a wheel for this Python; empy and the package itself have none.
  local source=(--no-binary empy --no-binary ember_ros)
  if [ -n "${SIM:-}" ]; then source+=(--no-binary pybullet); fi
  "$env/bin/uv" pip install --quiet --python "$env/bin/python" --resolution "$3" \
    --only-binary :all: "${source[@]}" --build-constraints "$work/build.txt" ".[$extras]"
  echo "  $("$env/bin/python" -m pip list --format freeze 2>/dev/null |
    grep -iE "^($(echo $SHOWN | tr ' ' '|'))==" | tr '\n' ' ')"
  "$env/bin/ember" --help >/dev/null
  "$env/lib/ember_ros/sim_node" --help >/dev/null
  if [[ $extras == *sim* ]]; then
    "$env/bin/ember" train --cycles 20 --out "$work/out/$2-$3/train" >/dev/null
    "$env/bin/ember" walk --table trained --cycles 3 --out "$work/out/$2-$3/walk" >/dev/null
  else
    echo "  without PyBullet: nothing was trained (SIM=1 compiles it)"
  fi
  (cd "$work" && "$env/bin/ember" replay walk >/dev/null)
  # pytest by its script and not by python -m, so that what is tried is what was installed. Old
  # releases use what newer ones of theirs call deprecated.
  # shellcheck disable=SC2086
  "$env/bin/pytest" -p no:cacheprovider -W ignore::DeprecationWarning $PURE >"$work/tests" || code=$?
  grep -E '^FAILED|^ERROR|passed|failed' "$work/tests" | sed 's/^/  /'
  return $code
}

# find VERSION: the first Python of that version that can make environments: of the PATH, or pyenv's.
find() {
  local python
  for python in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/"python$1"; do
    if "$python" -c 'import ensurepip, venv' 2>/dev/null; then
      echo "$python"
      return
    fi
  done
}

failed=0
for version in ${*:-3.10 3.11 3.12 3.13}; do
  python=$(find "$version")
  if [ -z "$python" ]; then
    echo "Python $version: not here"
    continue
  fi
  for resolution in lowest-direct highest; do
    echo "Python $version, $resolution"
    set +e  # in a condition, a command that fails would not end the subshell
    (set -e; try "$python" "$version" "$resolution") 2>"$work/errors"
    code=$?
    set -e
    if [ $code -ne 0 ]; then
      tail -n 20 "$work/errors"
      echo "  FAILED"
      failed=1
    fi
  done
done
exit $failed

#!/usr/bin/env bash
# Tests with a set of versions of torch, jax, NumPy, numba, trimesh, typer and the rest:
#
#     tests/versions.sh oldest   # constraints-oldest.txt: the oldest that pyproject.toml allows
#     tests/versions.sh pinned   # constraints.txt
#     tests/versions.sh newest   # whatever the package index has
#
# Variables: PYTHON, the interpreter (python3); VENV, the environment (.venv-SET); TORCH, a version of torch in place of
# the set's; WORKERS (2); MARKS, the tests (quick ones of engines and files, which would notice; "engines or files" adds
# those that compile long). Torch of the index brings gigabytes of CUDA, unless PIP_EXTRA_INDEX_URL names an index of
# builds without.
set -euo pipefail
cd "$(dirname "$0")/.."
set_=${1:?expected oldest, pinned or newest}
case $set_ in
oldest) constraints=constraints-oldest.txt ;;
pinned) constraints=constraints.txt ;;
newest) constraints=/dev/null ;;
*)
    echo "there is no set of versions '$set_'; expected oldest, pinned or newest" >&2
    exit 2
    ;;
esac
venv=${VENV:-.venv-$set_}
bin=$venv/bin
[ -d "$venv/Scripts" ] && bin=$venv/Scripts
[ -e "$bin/python" ] || "${PYTHON:-python3}" -m venv "$venv"

cat "$constraints" >"$venv/set.txt"
if [ -n "${TORCH:-}" ]; then
    { grep -v '^torch==' "$constraints" || true; echo "torch==$TORCH"; } >"$venv/set.txt"
fi
export PYTHONWARNINGS=ignore
upgrade=(--upgrade --upgrade-strategy eager)
[ "$set_" = newest ] || upgrade=()
"$bin/python" -m pip install --quiet "${upgrade[@]}" -c "$venv/set.txt" -e '.[all,test]' -e tests/plugin_example
unset PYTHONWARNINGS

"$bin/python" - <<'PYTHON'
from importlib.metadata import version
import platform

import jax, numba, numpy, torch, trimesh, typer  # noqa: E401

import rts

names = ("torch", "jax", "numpy", "numba", "trimesh", "typer")
print("Python", platform.python_version(), *(f"{name} {version(name)}" for name in names))
assert all(p.ready for p in rts.plugins("engines", details=True))
PYTHON
NUMBA_CACHE_DIR=$(realpath "$venv")/numba
export NUMBA_CACHE_DIR
"$bin/python" -m pytest -n "${WORKERS:-2}" --dist worksteal -p no:cacheprovider -m "${MARKS:-(engines or files) and not thorough}"
# A pose's fit, from far off: found, in torch and in jax.
for engine in torch jax; do
    "$bin/python" -m rts demo -o "$venv/demo-$engine" --engine "$engine"
    "$bin/python" - "$venv/demo-$engine/summary.json" <<'PYTHON'
import json
import sys

found = json.load(open(sys.argv[1], encoding="utf-8"))
print({name: found[name]["end"] for name in ("rotation_error_degrees", "translation_error_over_radius", "iou")})
assert found["rotation_error_degrees"]["end"] < 1 and found["iou"]["end"] > 0.98, found
PYTHON
done

#!/usr/bin/env bash
# Whether the wheel works by itself: installed into an empty environment, away from the sources, the demo runs, settings
# are compared on a model, and the tests of the example plugin and of a newly written one pass.
#
#     tests/wheel.sh <folder of the wheel> <folder of the example plugin> <constraints>
set -euo pipefail
dist=$(realpath "$1") example=$(realpath "$2") constraints=$(realpath "$3")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"${PYTHON:-python3}" -m venv venv
export PYTHONWARNINGS=ignore
wheel=$(ls "$dist"/rasterize_then_splat-*.whl)
cp -r "$example" plugin
venv/bin/python -m pip install --quiet --upgrade pip
venv/bin/python -m pip install --quiet -c "$constraints" "$wheel[torch,plots,cli]" "./plugin[test]"
unset PYTHONWARNINGS
venv/bin/python - <<'PYTHON'
import pathlib
import rts

assert "site-packages" in rts.__file__, rts.__file__
print(f"rts {rts.__version__} from {pathlib.Path(rts.__file__).parent.name} of the wheel")
PYTHON
venv/bin/rts demo -o out
test -s out/summary.md && test -s out/after.png
venv/bin/rts plugins
venv/bin/python -c "import trimesh; trimesh.creation.icosphere(3).export('model.obj')"
venv/bin/rts compare model.obj --quick -o out/compare
test -s out/compare/model.json && test -s out/compare/model.png && test -s out/compare/model.html
venv/bin/rts tune model.obj --tolerance 0.1 --mode translation
cd plugin
../venv/bin/python -m pytest -q -p no:cacheprovider tests
cd ..
venv/bin/rts new surface blob
venv/bin/python -m pip install --quiet ./rts-blob
venv/bin/python -m pytest -q -p no:cacheprovider rts-blob

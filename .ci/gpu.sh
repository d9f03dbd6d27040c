#!/usr/bin/env bash
# Renders one small data set with CUDA, compares it with LLVM's, and prints what both took: at most 8 minutes.
#
#     bash .ci/gpu.sh WHEELS [REFERENCE]
#
# It is for a machine with an NVIDIA driver (OptiX included), Python 3.11 or later, and no network. WHEELS is a folder
# that was filled elsewhere, for that machine's Python:
#
#     python3 -m pip download --only-binary=:all: --python-version 3.12 --platform manylinux_2_28_x86_64 \
#         --platform manylinux_2_27_x86_64 --platform manylinux2014_x86_64 --dest WHEELS '.[render]'
#
# A wheel may come in parts, NAME.whl.aa, NAME.whl.ab, ... (`split --bytes=20M`). Packages that the machine has are taken
# from it. REFERENCE is tests/smallest.toml rendered elsewhere with LLVM; without it LLVM renders here, and has to be here.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
wheels=${1:?give the folder of the wheels} reference=${2:-}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

mkdir "$work/wheels"
for first in "$wheels"/*.whl.aa; do
    [ -e "$first" ] && cat "${first%.aa}".?? > "$work/wheels/$(basename "${first%.aa}")"
done
cp "$wheels"/*.whl "$work/wheels/" 2>/dev/null || true
python3 -m venv --system-site-packages "$work/env"
"$work/env/bin/python" -m pip install --quiet --no-index --find-links "$work/wheels" mitsuba drjit
"$work/env/bin/python" -m pip install --quiet --no-index --find-links "$work/wheels" \
    cyclopts filelock jinja2 matplotlib OpenEXR pillow polars pooch pydantic rich scikit-image scipy
export PYTHONPATH=$PWD

nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader
timeout 420 "$work/env/bin/python" - "$work" "$reference" <<'PYTHON'
import sys
from pathlib import Path

from phibench.datasets.make import make_with_variant
from phibench.estimator.limits.variant_difference import table_of, variant_difference

work, reference = Path(sys.argv[1]), sys.argv[2]
cuda = make_with_variant("cuda", "tests/smallest.toml", work / "cuda")
llvm = Path(reference) if reference else make_with_variant("llvm", "tests/smallest.toml", work / "llvm")
found = variant_difference(llvm, cuda)
print(table_of("llvm", "cuda", found))
sys.exit(0 if found.agrees else 1)
PYTHON

#!/usr/bin/env bash
# Make an environment with LeRobot, openvima and this plugin: make_environment.sh FOLDER [PYTHON]
# LeRobot needs Python 3.12 or newer. It brings its own torch; for one without CUDA, set PIP_EXTRA_INDEX_URL to
# PyTorch's index of CPU builds. The last line printed is the Python for `openvima evaluate --python`.
set -eu
folder=${1:?"usage: make_environment.sh FOLDER [PYTHON]"} python=${2:-python3.12}
here=$(cd "$(dirname "$0")" && pwd)
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 12))' || { echo "$python is older than Python 3.12; name another one." >&2; exit 2; }
"$python" -m venv "$folder"
"$folder/bin/python" -m pip install 'lerobot[dataset,training,smolvla]>=0.6,<0.7'
"$folder/bin/python" -m pip install "$here/../..[serve]" "$here"
echo "$(cd "$folder" && pwd)/bin/python"

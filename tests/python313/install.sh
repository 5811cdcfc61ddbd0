#!/usr/bin/env bash
# install.sh FOLDER -- Python 3.13 below FOLDER, and what the parts of this package without torch need, on Debian.
# Debian 12 has no Python 3.13: Debian 13's is unpacked there, with the C library it was made for, and installed nowhere.
set -euo pipefail
cd "$(dirname "$0")/../.."
pip=$PWD/.venv/bin/pip constraints=$PWD/constraints.txt
mkdir -p "$1"
cd "$1"
if [ -x python ] && [ -e libraries/complete ]; then exit 0; fi
mkdir -p lists/partial cache/archives/partial debs root
echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://deb.debian.org/debian trixie main" >sources.list
apt=(-o "Dir::Etc::sourcelist=$PWD/sources.list" -o Dir::Etc::sourceparts=- -o "Dir::State::lists=$PWD/lists"
  -o "Dir::Cache=$PWD/cache" -o APT::Sandbox::User=root)
apt-get -qq "${apt[@]}" update
(cd debs && apt-get -qq "${apt[@]}" download python3.13 python3.13-minimal libpython3.13-minimal libpython3.13-stdlib \
  libc6 libgcc-s1 libstdc++6 libexpat1 zlib1g libssl3t64 libffi8 libsqlite3-0 libbz2-1.0 liblzma5 libuuid1 libzstd1)
for package in debs/*.deb; do dpkg -x "$package" root; done
lib=$PWD/root/usr/lib/x86_64-linux-gnu
cat >python <<END
#!/bin/sh
exec $PWD/root/usr/lib64/ld-linux-x86-64.so.2 --library-path $lib $PWD/root/usr/bin/python3.13 "\$@"
END
chmod +x python
./python --version
"$pip" install --quiet --disable-pip-version-check --python-version 3.13 --only-binary=:all: --no-deps \
  --constraint "$constraints" --target libraries \
  annotated-types annotated-doc cloudpickle contourpy click cycler farama-notifications fonttools gymnasium hypothesis \
  iniconfig jinja2 joblib kiwisolver llvmlite markdown-it-py markupsafe matplotlib mdurl numba numpy packaging pillow pluggy \
  psutil pydantic pydantic-core pygments pyparsing pytest pytest-timeout python-dateutil rich ruamel.yaml scikit-learn scipy \
  shellingham six sortedcontainers threadpoolctl typer typing-extensions typing-inspection
touch libraries/complete

#!/usr/bin/env bash
# install.sh -- qemu-user of version 8 or newer, which the tests on emulated CPUs need, on Debian as root.
# Debian 12's own is 7.2, which emulates an AVX2 instruction of NumPy's argsort wrongly: its backports have a newer one.
set -euo pipefail
newer() { qemu-x86_64 --version 2>/dev/null | grep -Eq 'version ([89]|[1-9][0-9])\.'; }
if newer; then exit 0; fi
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
  echo "install.sh: needs root and apt-get to install qemu-user" >&2
  exit 1
fi
export DEBIAN_FRONTEND=noninteractive
. /etc/os-release
apt-get update -qq
release=()
if [ "${VERSION_CODENAME:-}" = bookworm ]; then
  list=/etc/apt/sources.list.d/space_dist-backports.list
  echo "deb http://deb.debian.org/debian bookworm-backports main" >"$list"
  apt-get update -qq
  release=(--target-release bookworm-backports)
fi
apt-get install -y -qq --no-install-recommends "${release[@]}" qemu-user >/dev/null
newer

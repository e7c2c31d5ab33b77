#!/usr/bin/env bash
# Makes .venv from requirements.lock and installs the project and its LeRobot plugin into it, editable.
#
# Usage: scripts/make_venv.sh          (the Makefile calls it whenever the lock has changed)
#        PYTHON=/path/to/python3.12 scripts/make_venv.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

# LeRobot needs 3.12; NumPy below 2.3, which LeRobot asks for, has no wheels for 3.14.
SUITABLE='import sys; sys.exit(not ((3, 12) <= sys.version_info[:2] < (3, 14)))'
suitable() { "$1" -c "$SUITABLE" </dev/null >/dev/null 2>&1; }

have_uv() { uv --version >/dev/null 2>&1; }

# A name on the PATH may be a shim that fails, so every candidate is tried by running it.
find_python() {
  local candidate roots
  roots="${PYENV_ROOT:-} $(pyenv root 2>/dev/null || true) $HOME/.pyenv"
  for candidate in ${PYTHON:-} python3.12 python3.13 python3 python; do
    if suitable "$candidate"; then command -v "$candidate"; return; fi
  done
  for root in $roots; do
    for candidate in "$root"/versions/3.12*/bin/python "$root"/versions/3.13*/bin/python; do
      if suitable "$candidate"; then echo "$candidate"; return; fi
    done
  done
  for candidate in /usr/local/bin/python3.1[23] /opt/*/bin/python3.1[23] "$HOME"/*conda3/bin/python3; do
    if suitable "$candidate"; then echo "$candidate"; return; fi
  done
  if have_uv; then
    candidate="$(UV_PYTHON_DOWNLOADS=never uv python find '>=3.12,<3.14' 2>/dev/null || true)"
    if [ -n "$candidate" ] && suitable "$candidate"; then echo "$candidate"; return; fi
  fi
  return 1
}

if [ -n "${PYTHON:-}" ] && ! suitable "$PYTHON"; then
  fail "PYTHON=$PYTHON does not run, or is not Python 3.12 or 3.13."
fi

if suitable .venv/bin/python; then
  say "bringing .venv up to date with requirements.lock"
else
  python="$(find_python)" || fail "no Python 3.12 or 3.13 found on the PATH or in pyenv. Install one
       (for example 'pyenv install 3.12', 'uv python install 3.12' or your system's python3.12 and
       python3.12-venv packages), or name it: make demo PYTHON=/path/to/python3.12"
  say "making .venv with $("$python" --version 2>&1) ($python)"
  if have_uv; then
    uv venv --quiet --clear --python "$python" .venv
  else
    "$python" -m venv --clear .venv ||
      fail "$python cannot make virtual environments; install its venv package (python3-venv)."
  fi
fi

if have_uv; then
  uv=uv
else
  say "installing uv into .venv"
  .venv/bin/python -m pip install --quiet --disable-pip-version-check uv
  uv=.venv/bin/uv
fi

say "installing $(grep -c == requirements.lock) locked packages (about 6 GB with torch; one to five minutes)"
started=$SECONDS
# --no-deps: the lock is complete; anything it does not name must not slip in.
# --compile-bytecode: half a minute now; without it every process that loads LeRobot where Python may
# not write bytecode would compile for 8 s, and every simulation worker for 3 s.
"$uv" pip install --quiet --python .venv/bin/python --no-deps --compile-bytecode -r requirements.lock
"$uv" pip install --quiet --python .venv/bin/python --no-deps --no-build-isolation \
  --editable . --editable integrations/lerobot_env_hvs
touch .venv/.up-to-date
say "done in $((SECONDS - started)) s"

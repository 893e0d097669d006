# Sourced by tools/demo and tools/test: makes .venv when there is none, installs the project into it
# with the extras named in $1 (empty for none) and puts it on PATH. Installs again only when
# pyproject.toml has changed since the last time.
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 2

python=""
for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        python="$candidate"
        break
    fi
done
if [ ! -x .venv/bin/python ]; then
    if [ -z "$python" ]; then
        echo "companion needs Python 3.11 or newer on PATH (python3 --version says: $(python3 --version 2>&1))" >&2
        exit 2
    fi
    echo "Creating .venv with $python" >&2
    "$python" -m venv .venv || { echo "python -m venv failed; on Debian or Ubuntu: apt install python3-venv" >&2; exit 2; }
fi
stamp=".venv/installed-${1:-run}"
if ! cmp -s pyproject.toml "$stamp"; then
    echo "Installing the project${1:+ with the extras [$1]}; the first time this takes a minute or two" >&2
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".${1:+[$1]}" >&2 || exit 2
    cp pyproject.toml "$stamp"
fi
PATH="$PWD/.venv/bin:$PATH"
export PATH

# shellcheck shell=bash
# Set-up shared by scripts/phantom and scripts/test; to be sourced. Messages go to stderr.

PHANTOM_ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
# a relative target folder is meant from where the user is, not from where cargo will run
CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PHANTOM_ROOT/target}
[[ $CARGO_TARGET_DIR == /* ]] || CARGO_TARGET_DIR=$PWD/$CARGO_TARGET_DIR
export PHANTOM_ROOT CARGO_TARGET_DIR

say() {
    printf '%s\n' "$*" >&2
}

# die MESSAGE: ends the script; 2 is the exit code of everything the user has to put right.
die() {
    say "$(basename "$0"): $*"
    exit 2
}

# Finds cargo and checks the compiler against rust-version in Cargo.toml.
require_rust() {
    local wanted found
    wanted=$(sed -n 's/^rust-version = "\(.*\)"$/\1/p' "$PHANTOM_ROOT/Cargo.toml" | head -n 1)
    # rustup's folder, for shells that have not read the profile since it was installed
    command -v cargo >/dev/null || PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
    command -v cargo >/dev/null ||
        die "cargo was not found: install Rust $wanted or newer with rustup (https://rustup.rs)"
    found=$(cd "$PHANTOM_ROOT" && rustc --version 2>/dev/null | cut -d ' ' -f 2) || found=
    [[ -n $found ]] ||
        die "rustc does not run: install Rust $wanted or newer with rustup (https://rustup.rs)"
    [[ $(printf '%s\n' "$wanted" "$found" | sort -V | head -n 1) == "$wanted" ]] ||
        die "Rust $found is too old: install $wanted or newer with rustup (https://rustup.rs)"
}

is_installed() {
    [[ $(dpkg-query -W -f '${db:Status-Abbrev}' "$1" 2>/dev/null) == ii* ]]
}

# install_packages PACKAGE...: installs those Debian packages of the list that are missing.
install_packages() {
    local package missing=() as_root=() log reason
    { command -v dpkg-query && command -v apt-get; } >/dev/null ||
        die "this needs the Debian packages $*, and there is no apt-get here: see \"Other systems\" in scripts/README.md"
    for package; do
        is_installed "$package" || missing+=("$package")
    done
    ((${#missing[@]})) || return 0
    if ((EUID != 0)); then
        command -v sudo >/dev/null ||
            die "missing Debian packages: run \`apt-get install ${missing[*]}\` as root, then try again"
        as_root=(sudo)
    fi
    say "installing Debian packages: ${missing[*]}"
    log=$(mktemp)
    # package lists that are there may do; fetch them only if not
    if ! apt_install "${missing[@]}" >"$log" 2>&1; then
        "${as_root[@]}" apt-get update -qq >"$log" 2>&1 || true
        if ! apt_install "${missing[@]}" >>"$log" 2>&1; then
            reason=$(grep -E '^(E:|sudo:)' "$log" | tail -n 1) || reason="apt-get gave no reason"
            rm -f "$log"
            die "cannot install ${missing[*]}: ${reason#E: }"
        fi
    fi
    rm -f "$log"
}

# Part of install_packages, whose as_root it uses.
apt_install() {
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -q --no-install-recommends "$@" </dev/null
}

# All that the build needs. MUJOCO_DIR and LIBCLANG_PATH stand in for the packages.
set_up() {
    local packages=()
    require_rust
    command -v cc >/dev/null || packages+=(gcc libc6-dev)
    [[ -n ${MUJOCO_DIR:-} ]] || packages+=(libmujoco-dev)
    [[ -n ${LIBCLANG_PATH:-} ]] || packages+=(libclang-dev)
    [[ ${PHANTOM_FEATURES:-} != *mpi* ]] || command -v mpicc >/dev/null || packages+=(libopenmpi-dev openmpi-bin)
    ((${#packages[@]} == 0)) || install_packages "${packages[@]}"
}

# Builds the program, with PHANTOM_FEATURES if set; cargo knows whether there is anything to do.
build_release() {
    local quiet=(--quiet) features=()
    [[ -z ${PHANTOM_FEATURES:-} ]] || features=(--features "$PHANTOM_FEATURES")
    if [[ ! -x $CARGO_TARGET_DIR/release/phantom ]]; then
        say "building phantom, which takes a minute or two the first time"
        quiet=()
    fi
    (cd "$PHANTOM_ROOT" && cargo build --release --locked "${quiet[@]}" "${features[@]}" --bin phantom) >&2
}

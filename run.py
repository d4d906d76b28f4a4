#!/usr/bin/env python3
"""Set everything up and run it, with nothing but Python's standard library.

    python3 run.py demo [options]     map, texture and draw a shape made by the package itself; figures in out/
    python3 run.py test [options]     lint, type check and test; options go to pytest
    python3 run.py gpu [options]      try an NVIDIA card: tests, agreement with the CPU, times; a page in out/gpu
    python3 run.py COMMAND ...        any other command of omtwarp: map, texture, preview, check, report, ...

The first call makes a virtual environment in .venv, installs the package there and sees to the software OpenGL that the
previews use; later calls only run. On Debian and Ubuntu missing system packages are installed with apt where that is
allowed (as root, or with a sudo that asks for nothing), and OpenGL is otherwise unpacked into .gl without any rights.
Without OpenGL previews fall back to the package's own ray caster.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")
ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
GL = ROOT / ".gl"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
GL_LIBRARIES = ("libEGL.so.1", "libGL.so.1")
GL_PACKAGES = ("libegl1", "libgl1")
NODE = ROOT / ".node"
READERS = {"gltf-validator": "2.0.0-dev.3.10", "three": "0.187.0"}  # packages of node that tests read GLB with
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
EXTRAS = {"test": "test", "gpu": "test,cuda"}  # of every other command: preview
WHEELS = ROOT / "wheels"  # what `gpu` installs from without a network, where it is there; see docs/performance.md
NO_CARD = 3  # exit status of `gpu` without a card
INTERRUPTED = {130, 143}  # exit statuses


class SetupError(Exception):
    """A step of the set-up that failed, and what to do about it."""


def main(arguments: list[str]) -> int:
    """Set up what a command needs, run it, and return its exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__.strip())
        return 0 if arguments else 2
    command, options = arguments[0], arguments[1:]
    if command == "gpu" and not have_card():
        print("run.py: error: this machine has no NVIDIA card with a driver: nothing was run", file=sys.stderr)
        return NO_CARD
    try:
        if sys.version_info < (3, 11):  # noqa: UP036 (this script is the one that meets an older Python)
            raise SetupError(f"Python 3.11 or newer is needed, this is {sys.version.split()[0]}")
        make_environment()
        if command == "test":
            return test(options)
        if command == "gpu" and WHEELS.is_dir():
            install_wheels(WHEELS)
        else:
            install(EXTRAS.get(command, "preview"))
        environment = dict(os.environ) if command == "gpu" else {**os.environ, **opengl()}
    except SetupError as error:
        print(f"run.py: error: {error}", file=sys.stderr)
        return 1
    # Compiled kernels stay in the checkout: nothing is shared with other versions, and nothing is compiled twice.
    environment.setdefault("WARP_CACHE_PATH", str(ROOT / ".warp"))
    if command == "gpu":
        return run([str(ROOT / ".ci" / "gpu.py"), "--tests", str(ROOT / "tests"), *options], environment)
    return run(["-m", "omtwarp", command, *options], environment)


def test(options: list[str]) -> int:
    """Set up and check everything that has to be green; a later step still runs after one that failed."""
    environment = {"WARP_CACHE_PATH": str(ROOT / ".warp"), **os.environ}
    # Two processes share two cores: threads of a linear algebra library inside them would only get in each other's way.
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    # Tests start some hundred processes, each of which would compile the package's modules again.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    checks = {
        "lint": ["-m", "ruff", "check", "."],
        "format": ["-m", "ruff", "format", "--check", "."],
        "types": ["-m", "mypy"],
        # Each test process would compile every kernel for itself: compile them once before.
        "kernels": ["-m", "omtwarp.device.prewarm"],
        "dead code": ["-m", "vulture"],
    }
    steps = {"tests": ["-m", "pytest", "-n", "2", "--dist", "worksteal", *options], "size": [".ci/count.py"]}
    failed = {}
    with ThreadPoolExecutor() as network, ThreadPoolExecutor(2) as cores:
        # Packages of the system, of node and of Python wait for the network, and only the checks need the last of them.
        libraries, readers = network.submit(system_packages), network.submit(node_packages)
        install("test")
        begun = {name: cores.submit(quiet, [PYTHON, *check], ROOT, environment) for name, check in checks.items()}
        for name, check in checks.items():
            done = until_the_end(begun[name].result)
            say(f"{name}: python {' '.join(check)}")
            print(done.stdout, end="", flush=True)
            if status := exit_status(done.returncode):
                failed[name] = status
        environment |= until_the_end(libraries.result)
        until_the_end(readers.result)
    for name, step in steps.items():
        if INTERRUPTED & set(failed.values()):
            break
        say(f"{name}: python {' '.join(step)}")
        if status := run(step, environment):
            failed[name] = status
    if interrupted := INTERRUPTED & set(failed.values()):
        return interrupted.pop()
    say(f"failed: {', '.join(failed)}" if failed else "all green")
    return next(iter(failed.values()), 0)


def make_environment() -> None:
    """A virtual environment that works, made anew if there is none."""
    works = "import pip, sys; sys.exit(sys.version_info < (3, 11))"
    if PYTHON.exists() and quiet([PYTHON, "-P", "-c", works]).returncode == 0:
        return
    if quiet([sys.executable, "-P", "-c", "import ensurepip, venv"]).returncode != 0:
        # Debian splits these off.
        say("installing Python's venv module")
        if not apt_install(["python3-venv"], "python3-venv"):
            version = f"{sys.version_info.major}.{sys.version_info.minor}"
            apt_install([f"python{version}-venv"], f"python{version}-venv")
        if quiet([sys.executable, "-P", "-c", "import ensurepip, venv"]).returncode != 0:
            raise SetupError(
                "this Python has no venv module: install it (apt-get install python3-venv), or make the environment "
                f"yourself (uv venv --seed {VENV}; or virtualenv {VENV}) and run this again"
            )
    say(f"making a virtual environment in {VENV.name}")
    shutil.rmtree(VENV, ignore_errors=True)
    made = quiet([sys.executable, "-P", "-m", "venv", VENV])
    if made.returncode != 0:
        shutil.rmtree(VENV, ignore_errors=True)
        raise SetupError(f"the virtual environment could not be made: {last_line(made)}")


def install(extras: str) -> None:
    """The package and what it depends on, unless they were installed since pyproject.toml last changed."""
    state = hashlib.sha256((ROOT / "pyproject.toml").read_bytes() + str(ROOT).encode()).hexdigest()

    def stamp(extras: str) -> Path:
        return VENV / f".installed-{extras.replace(',', '-')}"

    marks = [stamp(extras), stamp("test")] if extras == "preview" else [stamp(extras)]  # the tests install it too
    if any(mark.exists() and mark.read_text() == state for mark in marks):
        return
    say(f"installing omtwarp[{extras}] and its dependencies (the first time only; a minute or so)")
    pip = [str(PYTHON), "-m", "pip", "install", "-qq", "--disable-pip-version-check"]
    what = ["-e", f".[{extras}]"]
    # uv takes half a minute where pip takes three, but does not read pip's settings, which some networks need.
    uv = [PYTHON, "-m", "uv", "pip", "install", "--python", PYTHON, *what]
    if extras == "test":
        pip.append("--no-compile")  # most of what tests need is never imported, the rest compiled when it is
    else:
        uv.append("--compile-bytecode")
    by_uv = quiet([*pip, "uv"]).returncode == 0 and quiet(uv, ROOT).returncode == 0
    if not by_uv and subprocess.call([*pip, *what], cwd=ROOT) != 0:
        raise SetupError("pip could not install the dependencies (its message is above); is there a network?")
    stamp(extras).write_text(state)


def have_card() -> bool:
    """Whether an NVIDIA driver is installed and sees a card."""
    count = ctypes.c_int(0)
    for name in ("nvcuda.dll",) if os.name == "nt" else ("libcuda.so.1", "libcuda.so"):
        try:
            driver = ctypes.CDLL(name)
        except OSError:
            continue
        return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
    return False


def install_wheels(folder: Path) -> None:
    """Install every wheel in a folder, without a network and without more, and put the checkout on the path.

    A large wheel may lie there in parts, NAME.whl.part00, NAME.whl.part01 and so on, as `split -d -b 60m` makes them.
    """
    joined = VENV / "wheels"
    joined.mkdir(exist_ok=True)
    parts = sorted(folder.glob("*.whl.part*"))
    for name in dict.fromkeys(part.name.partition(".part")[0] for part in parts):
        with open(joined / name, "wb") as whole:
            for part in parts:
                if part.name.startswith(f"{name}.part"):
                    with open(part, "rb") as piece:
                        shutil.copyfileobj(piece, whole)
    # Names in place of files: pip then takes the wheels for this Python, where there are some for several.
    files = [*folder.glob("*.whl"), *joined.glob("*.whl")]
    names = sorted({file.name.split("-")[0] for file in files})
    if not names:
        raise SetupError(
            f"there are no wheels in {folder}: put some there, or remove the folder to install from a network"
        )
    say(f"installing {len(names)} packages from {folder.name}")
    command = [PYTHON, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-index", "--no-deps"]
    done = quiet([*command, "--find-links", folder, "--find-links", joined, *names])
    if done.returncode != 0:
        raise SetupError(f"pip could not install the wheels in {folder}: {last_line(done)}")
    place = quiet([PYTHON, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"])
    (Path(last_line(place)) / "omtwarp-checkout.pth").write_text(f"{ROOT}\n")


def opengl() -> dict[str, str]:
    """See to a software OpenGL; returns the environment variables that make it found."""
    if not sys.platform.startswith("linux"):
        return {}
    if not have_opengl() and not GL.exists():
        say("installing OpenGL (libegl1, libgl1) for the previews")
        if not apt_install(list(GL_PACKAGES), "OpenGL") and not unpack_opengl():
            say("no OpenGL: previews use the ray caster (for OpenGL: apt-get install libegl1 libgl1)")
    if have_opengl() or not GL.exists():
        return {}
    library = next(GL.glob("usr/lib/*/libEGL.so.1"), GL / "none").parent
    paths = [str(library), os.environ.get("LD_LIBRARY_PATH", "")]
    return {
        "LD_LIBRARY_PATH": ":".join(path for path in paths if path),
        "LIBGL_DRIVERS_PATH": str(library / "dri"),
        "__EGL_VENDOR_LIBRARY_DIRS": str(GL / "usr/share/glvnd/egl_vendor.d"),
    }


def system_packages() -> dict[str, str]:
    """See to what the tests need of the system, one after the other: apt-get refuses to run twice at a time."""
    browser()
    return opengl()


def browser() -> None:
    """See to a browser for the tests of report pages; without one they are skipped."""
    if not any(map(shutil.which, BROWSERS)) and sys.platform.startswith("linux") and shutil.which("apt-get"):
        say("installing a browser (chromium) for the tests of report pages")
        apt_install([BROWSERS[0]], "chromium: the tests that need a browser are skipped")


def node_packages() -> None:
    """See to the readers of glTF for the tests, where npm is there; without them those tests are skipped."""
    if not shutil.which("npm") or all((NODE / "node_modules" / name).is_dir() for name in READERS):
        return
    say("installing gltf-validator and three.js for the tests of GLB files")
    wanted = [f"{name}@{version}" for name, version in READERS.items()]
    if quiet(["npm", "install", "--no-save", "--no-audit", "--no-fund", "--prefix", NODE, *wanted]).returncode != 0:
        say("no packages of node: the tests that read GLB with them are skipped")


def have_opengl() -> bool:
    """Whether the system's loader finds the two libraries that a preview without a display needs."""
    try:
        for name in GL_LIBRARIES:
            ctypes.CDLL(name)
    except OSError:
        return False
    return True


def apt_install(packages: list[str], what: str) -> bool:
    """Install Debian packages as root or with a sudo that asks for no password."""
    if not shutil.which("apt-get"):
        return False
    prefix: list[str] = []
    if os.geteuid() != 0:
        if not shutil.which("sudo") or quiet(["sudo", "-n", "true"]).returncode != 0:
            return False
        prefix = ["sudo", "-n"]
    apt = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq", "-o", "Acquire::Retries=3"]
    command = [*apt, "install", "-y", "--no-install-recommends", *packages]
    done = quiet(command)
    if done.returncode != 0:  # lists that are missing or out of date
        updated = quiet([*apt, "update"])
        done = quiet(command) if updated.returncode == 0 else updated
    if done.returncode != 0:
        say(f"apt-get could not install {what}: {last_line(done)}")
    return done.returncode == 0


def unpack_opengl() -> bool:
    """The same packages without any rights: apt only resolves and downloads, dpkg-deb only unpacks, all into .gl."""
    if not all(map(shutil.which, ("apt-get", "dpkg-deb"))):
        return False
    work = ROOT / ".gl-download"
    shutil.rmtree(work, ignore_errors=True)
    for folder in ("lists/partial", "archives/partial", "unpacked"):
        (work / folder).mkdir(parents=True)
    options = [
        "-qq",
        *("-o", f"Dir::State::Lists={work / 'lists'}"),
        *("-o", f"Dir::Cache={work}"),
        *("-o", f"Dir::Cache::Archives={work / 'archives'}"),
        *("-o", "Dir::State::status=/var/lib/dpkg/status"),
        *("-o", "Debug::NoLocking=1"),
        *("-o", "Acquire::Retries=3"),
    ]
    try:
        for step in (["update"], ["install", "-y", "--no-install-recommends", "--download-only", *GL_PACKAGES]):
            done = quiet(["apt-get", *options, *step])
            if done.returncode != 0:
                say(f"apt-get could not download OpenGL: {last_line(done)}")
                return False
        archives = sorted((work / "archives").glob("*.deb"))
        if not archives or any(quiet(["dpkg-deb", "-x", deb, work / "unpacked"]).returncode for deb in archives):
            return False
        (work / "unpacked").rename(GL)
        return True
    finally:
        shutil.rmtree(work, ignore_errors=True)


def run(arguments: list[str], environment: dict[str, str]) -> int:
    """Run the environment's Python in the caller's directory, its output passed through."""
    where = ROOT if arguments[:2] != ["-m", "omtwarp"] else None
    safe = [] if where else ["-P"]  # the caller's directory is no place for modules
    process = subprocess.Popen([str(PYTHON), *safe, *arguments], env=environment, cwd=where)
    return exit_status(until_the_end(process.wait))


def exit_status(returned: int) -> int:
    """What a shell makes of a process's end."""
    return returned if returned >= 0 else 128 - returned


def until_the_end(wait: Callable[[], T]) -> T:
    """Wait for a process on Ctrl-C too: the terminal has sent it to the process as well, which ends in its own way."""
    while True:
        try:
            return wait()
        except KeyboardInterrupt:
            pass


def quiet(
    command: list, cwd: Path | None = None, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess:
    """Run something whose output is looked at when it has ended."""
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )


def last_line(done: subprocess.CompletedProcess) -> str:
    lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit status {done.returncode}"


def say(text: str) -> None:
    print(f"run.py: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""The package's version."""

from importlib.metadata import PackageNotFoundError, version


def package_version() -> str:
    """Return the installed version, or ``0+unknown`` in a checkout that was never installed."""
    try:
        return version("omtwarp")
    except PackageNotFoundError:
        return "0+unknown"

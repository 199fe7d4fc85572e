"""Data Version Control, whose package is called ``dvc`` too: installed beside this one, each overwrites the other."""

from importlib.metadata import PackageNotFoundError, distribution


def refuse_data_version_control() -> None:
    """Raise ImportError where the distribution ``dvc`` is installed in the same environment; takes milliseconds."""
    try:
        version = distribution("dvc").version
    except PackageNotFoundError:
        return
    raise ImportError(
        f"Data Version Control {version} is installed in this environment, and its package 'dvc' has the same name as "
        "one of mrstrain. Install mrstrain in an environment of its own: python -m venv mrstrain-env, and install it "
        "there."
    )

"""Files that ship with the project, and how a user names them."""

from pathlib import Path

from companion.errors import UserError


def params_dir() -> Path:
    """Folder of the files that ship with the project: `params/` of a checkout, or its copy in a wheel."""
    here = Path(__file__).parent
    return next(p for p in (here / "_params", here.parent / "params") if p.is_dir())


def named_file(path: Path, kind: str) -> Path:
    """A file of the user's, or one of ours in `params/KIND` by its bare name.

    Raises:
        UserError: a bare name that neither has; names ours.
    """
    if path.exists() or path.suffix or path.name != str(path):
        return path
    ours = params_dir() / kind / f"{path}.toml"
    if not ours.exists():
        names = ", ".join(sorted(p.stem for p in ours.parent.glob("*.toml")))
        raise UserError(f"no file {path} and none of that name in params/{kind}; there are: {names}")
    return ours

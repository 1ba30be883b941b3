"""`latentds` and `python -m latentds`: the command, or one line that says what to install for it."""

from __future__ import annotations


def main() -> None:
    try:
        from .cli import app
    except ModuleNotFoundError as error:
        raise SystemExit(f"latentds: the command needs {error.name}: pip install 'latentds[cli]'") from None
    app(prog_name="latentds")


if __name__ == "__main__":
    main()

"""The command line: short verbs over the public API, one file each. Nothing heavy is imported before a verb runs."""

from __future__ import annotations

# As few imports as can be: until `main` runs, Ctrl-C ends in a traceback.
import signal
import sys
from importlib import import_module
from typing import Any

_VERBS = (  # the order of the help
    "demo",
    "adjust",
    "batch",
    "split",
    "resect",
    "models",
    "residuals",
    "compare",
    "simulate",
    "reproduce",
    "convert",
    "lists",
)


def __getattr__(name: str) -> Any:
    """Load the application when it is first asked for: `main` must be there to catch Ctrl-C before that."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    for verb in _VERBS:
        import_module(f"baarda.cli.{verb}")
    return import_module("baarda.cli.base").app


def main() -> None:
    """Run the command line; Ctrl-C, and a request to end (SIGTERM) like it, end it with one line and 128 + the number of the signal."""
    caught: list[int] = []

    def stop(number: int, _: object) -> None:
        caught.append(number)
        raise KeyboardInterrupt

    before: dict[int, Any] = {}
    code: Any = 0
    try:
        import threading

        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) not in (signal.SIG_IGN, None):  # a shell lets jobs in the background ignore Ctrl-C
                    before[number] = signal.signal(number, stop)
        __getattr__("app")()
    except KeyboardInterrupt:
        code = _interrupted()
    except SystemExit as left:
        code = left.code
        if isinstance(getattr(left.__context__, "__cause__", None), KeyboardInterrupt):  # it came before or after the verb
            code = _interrupted()
        elif code == 1 and isinstance(left.__context__, OSError):  # nobody reads the help; 1 is a gate that failed
            code = 4
    except Exception as error:
        if caught:  # an import that was interrupted may end in any way
            code = _interrupted()
        else:
            print(f"baarda: {unforeseen(error)}", file=sys.stderr)
            code = 2
    finally:
        for which, handler in before.items():
            signal.signal(which, handler)
    sys.exit(128 + caught[0] if caught and code else code)


def unforeseen(error: Exception) -> str:
    """Return one line about an error that nobody foresaw, with its place; ``python -X dev`` shows the way there, too.

    Parameters
    ----------
    error : Exception

    Returns
    -------
    str
    """
    import traceback
    from pathlib import Path

    from baarda.errors import shown

    if sys.flags.dev_mode:
        traceback.print_exception(error)
    home = Path(__file__).resolve().parent.parent
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).is_relative_to(home)]
    place = f" ({Path(frames[-1].filename).relative_to(home).as_posix()}, line {frames[-1].lineno})" if frames else ""
    return shown(" ".join(f"unforeseen {type(error).__name__}: {error}".split()) + f"{place}; please report it")


def _interrupted() -> int:
    print("baarda: interrupted, nothing was written", file=sys.stderr)
    return 130

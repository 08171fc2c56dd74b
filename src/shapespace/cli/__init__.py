"""The command line: parsing, printing and exit codes; what the commands do stands in `commands`.

Exit codes: 0 done; 1 some of several scans failed (or, under --strict, are doubtful); 2 wrong arguments or unusable
input; 130 stopped by Ctrl-C, files valid.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Sequence

from shapespace.cli.arguments import parser
from shapespace.cli.printing import say
from shapespace.errors import ShapespaceError

__all__ = ["main", "parser"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A file's name may hold what the terminal's encoding cannot show.
            stream.reconfigure(errors="backslashreplace")
    arguments = parser().parse_args(argv)
    try:
        code = int(arguments.run(arguments))
        sys.stdout.flush()
        return code
    except ShapespaceError as error:
        say(f"shapespace: {error}")
        return 2
    except MemoryError:
        say("shapespace: there is not enough memory for this; give fewer or smaller meshes, or fewer --jobs.")
        return 2
    except KeyboardInterrupt:
        say(f"shapespace: stopped; the files written so far are whole{getattr(arguments, 'goes_on', '')}.")
        return 130
    except BrokenPipeError:
        _drop_output()
        return 0
    except OSError as error:
        _drop_output()
        where = f" ({error.filename})" if error.filename else ""
        say(f"shapespace: the system refused{where}: {error.strerror or error}; check the path and the free space.")
        return 2


def _drop_output() -> None:
    """Send what is left of the output nowhere, so that python does not complain when it flushes at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

# SPDX-License-Identifier: MIT
"""``PYTHON launch.py [--packages DIR] [--folder DIR] [--parent PID] MODULE ARGS…``: run a module of this file's tree.

An installed extension is called ``bl_ext.<repository>.physgen``, and the interpreter that simulates may have no
``physgen``, or another version of it. Here the tree becomes the package ``physgen``, whatever else is installed, so
that caller and worker run the same code.

MODULE: from the tree's root, such as ``batch.cli``. --packages: another folder of packages, such as the extension's
wheels; searched last, and inherited by child processes. --folder: the working folder. --parent: a process; when it has
ended, this one is asked to stop, then ended. No syntax newer than Python 3.6, so that an old interpreter can report its
version.
"""

import importlib.util
import os
import runpy
import signal
import sys
import threading
import time
from pathlib import Path

PACKAGE = "physgen"
PACKAGES_VARIABLE = "PHYSGEN_PACKAGES"
OLDEST = (3, 11)
ONE_BLAS_THREAD = ("OPENBLAS_NUM_THREADS", "1")
"""Matrices here are small: more threads wait on each other, and sums would depend on how many cores there are."""
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGBREAK") if hasattr(signal, name))
"""Signals that ask to stop; on Windows a process asks another by Ctrl-Break, which would end it at once."""
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
    # The end of the terminal, unless it is to be ignored, as nohup has it.
    STOP_SIGNALS = (*STOP_SIGNALS, signal.SIGHUP)
ORPHAN_GRACE_S = 20.0
"""Time for an orphaned process to clean up."""


def main(arguments: "list[str]") -> None:
    """Parse the options in ``arguments`` and run the module as ``__main__``."""
    if sys.version_info[:2] < OLDEST:
        sys.exit("Python {}.{} is too old: 3.11 to 3.13 are needed".format(*sys.version_info[:2]))
    for number in STOP_SIGNALS:
        # Until the module takes them over: imports take seconds, and nothing has been written yet.
        signal.signal(number, lambda *_: os._exit(130))
    # Python puts the script's folder first in its search path, where ours could shadow modules of the same names.
    here = Path(__file__).absolute().parent
    hiding = (here, here.parents[1] / "batch")
    sys.path[:] = [entry for entry in sys.path if Path(entry).absolute() not in hiding]
    os.environ.setdefault(*ONE_BLAS_THREAD)
    while arguments and arguments[0].startswith("--"):
        option, value = arguments[:2]
        arguments = arguments[2:]
        if option == "--packages":
            os.environ[PACKAGES_VARIABLE] = value
        elif option == "--folder":
            os.chdir(value)
        elif option == "--parent":
            threading.Thread(target=_end_with, args=(int(value),), daemon=True).start()
        else:
            sys.exit(f"launch.py: unknown option {option}")
    packages = os.environ.get(PACKAGES_VARIABLE, "")
    if packages and packages not in sys.path:
        sys.path.append(packages)
    load_tree(here.parents[1])
    sys.argv = arguments
    runpy.run_module(PACKAGE + "." + arguments[0], run_name="__main__", alter_sys=True)


def _end_with(parent: int) -> None:
    """Wait until the process ``parent`` has ended, then end this one."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(ORPHAN_GRACE_S)
    os._exit(130)


def load_tree(root: Path) -> None:
    """Make the folder ``root`` the package ``physgen``."""
    spec = importlib.util.spec_from_file_location(
        PACKAGE, str(root / "__init__.py"), submodule_search_locations=[str(root)]
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = module
    spec.loader.exec_module(module)


if __name__ == "__main__":
    main(sys.argv[1:])

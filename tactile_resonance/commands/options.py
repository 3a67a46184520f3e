# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, checks before any work is done, how far long work is."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tactile_resonance.fields import require

FIGURES = (".png", ".pdf", ".svg")
YAML = (".yaml", ".yml")


def add_option(
    parser: argparse._ActionsContainer, option: str, value: Any, text: str = "", **more: Any
) -> None:
    """An option, or an argument, said once: as help shows it, and its default, from which its kind follows.

    Parameters
    ----------
    parser : ArgumentParser, or a group of one
    option : str
        Its name and what stands for its value or values: ``"--order N"``, ``"--band LO HI"``.
    value : object
        The default, of the kind of the values, which help tells after the text unless it is empty or NaN. A
        kind alone: there is none, or one in `more` that the text tells of. False: an option without a value.
    text : str
        For help.
    **more
        Of ``add_argument``.
    """
    name, *placeholders = option.split()
    if placeholders:
        more["metavar"] = placeholders[0]
    if len(placeholders) > 1:
        more |= {"metavar": tuple(placeholders), "nargs": len(placeholders)}
    if value is False:
        more["action"] = "store_true"
    elif callable(value):
        more["type"] = value
    else:
        more |= {"type": type(value), "default": value}
        if value != "" and value == value:
            default = f"default: {value:g}" if isinstance(value, float) else f"default: {value}"
            text = f"{text} ({default})" if text else default
    parser.add_argument(name, help=text, **more)


def add_runs(parser: argparse.ArgumentParser) -> None:
    """Folders of one or several runs."""
    add_option(parser, "runs RUN", Path, "folder of a run", nargs="+")


class _Output(argparse.Action):
    """Takes the path of a file to be written; refuses before any work is done what cannot be."""

    def __init__(self, *given: Any, endings: Sequence[str] = (), **more: Any) -> None:
        super().__init__(*given, **more)
        self._endings = endings

    def __call__(
        self, parser: argparse.ArgumentParser, taken: argparse.Namespace, path: Any, *_: object
    ) -> None:
        option, folder = self.option_strings[0], path.parent
        writable = folder.is_dir() and os.access(folder, os.W_OK)
        require(writable, option, str(path), "a file in a folder that can be written")
        regular = not path.exists() or path.is_file()
        require(regular, option, str(path), "a new file, or a regular one to replace")
        right = not self._endings or path.suffix.lower() in self._endings
        require(right, option, str(path), f"a file that ends in {', '.join(self._endings)}")
        setattr(taken, self.dest, path)


def add_output(
    parser: argparse._ActionsContainer, option: str, text: str, *endings: str, **more: Any
) -> None:
    """An option that names a file to be written, checked as the arguments are read.

    The endings are those of its kind, so that no file of another kind, a record for example, is replaced.
    """
    add_option(parser, option, Path, text, action=_Output, endings=endings, **more)


def add_figure(parser: argparse._ActionsContainer, option: str, text: str) -> None:
    """An option that names a figure to be written."""
    *first, last = FIGURES
    add_output(parser, f"{option} FILE", f"{text} ({', '.join(first)} or {last})", *FIGURES)


def add_band(parser: argparse.ArgumentParser, default: str) -> None:
    """The option ``--band``; None where it is not given."""
    text = f"[Hz] of the fit; default: {default}"
    add_option(parser, "--band LO HI", float, text, dest="band_hz")


def require_packages(*packages: str) -> None:
    """``ValueError`` where one is not installed."""
    for package in packages:
        if find_spec(package) is None:
            raise ValueError(
                f"{package} not found: this needs ROS 2, ur-rtde, python-can, rosbags and plotly; use "
                "'make demo', or build the package with colcon in a sourced ROS 2 and source its install folder"
            )


class ProgressBar(AbstractContextManager["ProgressBar"]):
    """How far work is: a bar on a terminal, lines elsewhere.

    Parameters
    ----------
    **options
        Of ``tqdm``.
    """

    def __init__(self, **options: Any) -> None:
        from tqdm import tqdm

        self._bar = tqdm(unit="point", file=sys.stderr, leave=False, disable=None, **options)
        self._said: object = None

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def show(self, what: str, done: int, of: int, key: object, line: str, beside: str = "") -> None:
        """Take how many points are done; where there is no bar, `line` is printed for each new `key`."""
        bar = self._bar
        if bar.disable:
            if key != self._said:
                self._said = key
                print(line, flush=True)
            return
        if done < bar.n:
            bar.reset(of)
        bar.total = of
        bar.set_postfix_str(beside, refresh=False)
        bar.update(done - bar.n)
        if bar.desc != f"{what}: ":
            bar.set_description(what)

    def say(self, text: str) -> None:
        """Print a line beside the bar."""
        self._bar.write(text, file=sys.stdout)
        sys.stdout.flush()

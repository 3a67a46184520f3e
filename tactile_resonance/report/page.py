# SPDX-License-Identifier: Apache-2.0
"""The shell of a page that needs nothing else: styles, plotly.js, our script, data and sections in one file.

The page may load nothing: its Content-Security-Policy allows the two scripts that it holds, by their hashes,
and no connection but that of a live page to the server it came from. Texts of runs reach it as JSON, which the
script shows as text, and in sections that are escaped.
"""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

from tactile_resonance.report.page_data import as_json

_FOLDER = "assets"


@cache
def _asset(name: str) -> str:
    return (resources.files(__package__) / _FOLDER / name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    try:
        return (resources.files("plotly") / "package_data" / "plotly.min.js").read_text(
            encoding="utf-8"
        )
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise ValueError(
            f"report: plotly.js was not found ({error}); the page needs 'pip install plotly'"
        ) from error


@cache
def _scripts() -> tuple[str, str]:
    """Both scripts as elements of HTML, and their hashes as a Content-Security-Policy takes them."""
    texts = (_plotly(), _asset("page.js"))
    digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
    return (
        "".join(f"<script>{text}</script>" for text in texts),
        " ".join(f"'sha256-{digest}'" for digest in digests),
    )


def content_security_policy(live: bool) -> str:
    """What a page may load: nothing, or, live, events of its own server."""
    return (
        f"default-src 'none'; script-src {_scripts()[1]}; style-src 'unsafe-inline'; img-src data: blob:; "
        f"connect-src {chr(39)}{'self' if live else 'none'}{chr(39)}; base-uri 'none'; form-action 'none'"
    )


def page(
    title: str, head: str, data: Mapping[str, Any], sections: str = "", live: bool = False
) -> str:
    """HTML of a page.

    Parameters
    ----------
    title : str
        Text.
    head, sections : str
        HTML above and below the interactive part; texts of runs in it are escaped.
    data : mapping
        What `page.js` shows.
    live : bool
        Whether it goes on to listen to the server it came from.
    """
    policy = html.escape(content_security_policy(live), quote=True)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_asset('page.css')}</style>"
        "<noscript><style>.paper { display: block }</style></noscript></head><body>"
        f'{head}<div id="interactive"></div>{sections}'
        f'<script type="application/json" id="data">{as_json({**data, "live": live})}</script>'
        f"{_scripts()[0]}</body></html>\n"
    )

"""A self-contained web page: its style, tables and pictures, for the reports."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

STYLE = """
:root{color-scheme:light dark;--bg:#fff;--text:#222;--quiet:#5d5d5d;--line:#ddd;--card:#f3f6fa}
@media(prefers-color-scheme:dark){:root{--bg:#12171c;--text:#e4e8ec;--quiet:#a3adb8;--line:#39434d;--card:#1c242c}}
body{font:16px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:var(--text);
background:var(--bg);overflow-wrap:anywhere}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2.2rem;border-bottom:1px solid var(--line)}
.verdict{font-size:1.25rem;padding:1rem 1.2rem;border-left:6px solid #4c72b0;background:var(--card)}
table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{text-align:left;padding:.3rem .6rem;border-bottom:1px solid var(--line);
font-variant-numeric:tabular-nums;overflow-wrap:normal}
.wide{overflow-x:auto}.wide:focus-visible,pre:focus-visible{outline:2px solid #4c72b0}
img{max-width:100%;background:#fff}.quiet{color:var(--quiet);font-size:.85rem}
pre{background:var(--card);padding:.8rem;overflow:auto;font-size:.8rem}
@media(max-width:46rem){img{max-width:none;width:46rem}body{margin-top:1rem}}
"""


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; every cell is escaped."""
    lines = [''.join(f'<td>{html.escape(str(cell))}</td>' for cell in row) for row in rows]
    head = ''.join(f'<th>{html.escape(h)}</th>' for h in header)
    return wide(f'<table><tr>{head}</tr>' + ''.join(f'<tr>{line}</tr>' for line in lines) + '</table>', 'table')


def wide(content: str, words: str) -> str:
    """What may be wider than a phone: it is moved by itself, also with the keyboard."""
    return f'<div class="wide" role="group" tabindex="0" aria-label="{html.escape(words)}">{content}</div>'


def picture(figure: Figure, words: str) -> str:
    """The figure as a picture in the page; ``words`` say what it shows, for who cannot see it."""
    buffer = io.BytesIO()
    figure.set_dpi(110)
    canvas: Any = FigureCanvasAgg(figure)
    # Not savefig, which goes through the drawing twice.
    canvas.print_png(buffer)
    code = base64.b64encode(buffer.getvalue()).decode()
    return wide(f'<img alt="{html.escape(words)}" src="data:image/png;base64,{code}">', f'picture: {words}')


def page(title: str, body: Iterable[str]) -> str:
    """The page with ``body``, its parts in order."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>'
        f'<style>{STYLE}</style></head><body><main>{"".join(body)}</main></body></html>'
    )

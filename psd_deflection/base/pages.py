# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A self-contained web page: its style, its tables, its policy and the scripts of its charts, for the reports."""

import base64
import hashlib
import html
from collections.abc import Iterable, Sequence

from psd_deflection.base.charts import CHARTS, FOLDER, MARK, UPLOT, UPLOT_STYLE, joined, text

STYLE = """
:root{color-scheme:light dark;--bg:#fff;--text:#222;--quiet:#5d5d5d;--line:#ddd;--card:#f3f6fa;--grid:#e6ebf0;
--blue:#2f66b5;--red:#c0392b;--green:#2a7a4b;--violet:#7d4fa3;--orange:#b35c00}
@media(prefers-color-scheme:dark){:root{--bg:#12171c;--text:#e4e8ec;--quiet:#a3adb8;--line:#39434d;--card:#1c242c;--grid:#26303a;
--blue:#7fb2f0;--red:#ff8a80;--green:#6fcf97;--violet:#c79bea;--orange:#ffb066}}
body{font:16px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:var(--text);
background:var(--bg);overflow-wrap:anywhere}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2.2rem;border-bottom:1px solid var(--line)}
.verdict{font-size:1.25rem;padding:1rem 1.2rem;border-left:6px solid #4c72b0;background:var(--card)}
table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{text-align:left;padding:.3rem .6rem;border-bottom:1px solid var(--line);
font-variant-numeric:tabular-nums;overflow-wrap:normal}
.wide{overflow-x:auto}.wide:focus-visible,pre:focus-visible{outline:2px solid #4c72b0}
img{max-width:100%}.quiet{color:var(--quiet);font-size:.85rem}
.bars{table-layout:fixed}.bars th{font-weight:400;overflow-wrap:break-word}.bars tr>:first-child{width:34%}
.bars i{display:inline-block;width:calc(var(--w)*(100% - 5rem));height:.8em;background:var(--tone);margin-right:.4em;
border-radius:0 2px 2px 0}
.tone{margin-right:1rem}.tone::before{content:"";display:inline-block;width:.8em;height:.8em;background:var(--tone);
margin-right:.35em;border-radius:2px}
.matrix{max-width:none}.matrix text{font-size:10px;fill:currentColor}
pre{background:var(--card);padding:.8rem;overflow:auto;font-size:.8rem}
@media(max-width:46rem){body{margin-top:1rem}
.bars i{display:block;width:calc(var(--w)*100%);height:.6em}}
"""


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; every cell is escaped."""
    lines = [''.join(f'<td>{html.escape(str(cell))}</td>' for cell in row) for row in rows]
    head = ''.join(f'<th>{html.escape(h)}</th>' for h in header)
    return wide(f'<table><tr>{head}</tr>' + ''.join(f'<tr>{line}</tr>' for line in lines) + '</table>', 'table')


def wide(content: str, words: str) -> str:
    """What may be wider than a phone: it is moved by itself, also with the keyboard."""
    return f'<div class="wide" role="group" tabindex="0" aria-label="{html.escape(words)}">{content}</div>'


def page(title: str, body: Iterable[str]) -> str:
    """The page with ``body``, its parts in order. It asks for nothing, and only the scripts of charts may run in it."""
    content = ''.join(body)
    style, scripts = STYLE, dict[str, str]()
    if MARK in content:
        style += text(UPLOT_STYLE) + text(FOLDER / 'report.css')
        scripts = {'text/javascript': text(UPLOT), 'module': joined(CHARTS, FOLDER / 'report.js')}
    allowed = ' '.join(map(_digest, scripts.values())) or "'none'"
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>'
        f'<style>{style}</style></head><body><main>{content}</main>'
        + ''.join(f'<script type="{kind}">{script}</script>' for kind, script in scripts.items())
        + '</body></html>'
    )


def _digest(script: str) -> str:
    """By which the policy of a page knows a script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"

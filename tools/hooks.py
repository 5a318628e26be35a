# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Mends the site's pages for people and screen readers while mkdocs builds them."""

import re
from typing import Any


def on_page_content(html: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page: convert Sphinx roles in docstrings, which mkdocs does not render."""
    html = re.sub(r':(?:class|meth|func|mod|data|attr):(?=<code>)', '', html)
    return re.sub(r'<code>~[\w.]*\.(\w+)</code>', r'<code>\1</code>', html)


def on_post_page(output: str, **kwargs: Any) -> str:
    """mkdocs calls it for each finished page: name what the theme leaves without a name, for screen readers."""

    def named(nav: re.Match[str]) -> str:
        title = re.search(rf'<label class="md-nav__title" for="{nav[1]}">(.*?)</label>', output, re.S)
        return nav[0] if title is None else f'aria-label="{" ".join(re.sub("<[^>]+>", "", title[1]).split())}"'

    html = re.sub(r'aria-labelledby="(__nav_[\d_]+)_label"', named, output)
    search = 'data-md-component="search" role="dialog"'
    return html.replace(f'{search}>', f'{search} aria-label="Search">')


def on_post_template(output: str, template_name: str, **kwargs: Any) -> str:
    """mkdocs calls it for each page that has no Markdown, such as 404.html."""
    return on_post_page(output) if template_name.endswith('.html') else output

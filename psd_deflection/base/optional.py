# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which extra brings a package that is not installed."""

from __future__ import annotations

from psd_deflection.base.errors import ConfigError

EXTRAS = {
    'matplotlib': ('plot', 'python3-matplotlib'),
    'shtab': ('completion', ''),
    'lz4': ('lz4', 'python3-lz4'),
    'zstandard': ('', 'python3-zstandard'),
}
"""By the imported name: the extra of setup.cfg ('': a dependency that rosdep cannot name) and the package of apt."""


def not_installed(error: ModuleNotFoundError) -> ConfigError | None:
    """Return the error that says how to install the missing package; None if it is none of ``EXTRAS``."""
    name = (error.name or '').partition('.')[0]
    if name not in EXTRAS:
        return None
    extra, apt = EXTRAS[name]
    pip = f"`pip install 'psd_deflection[{extra}]'`" if extra else f'`pip install {name}`'
    return ConfigError(f'{name} is not installed: {pip}' + (f' or `apt install {apt}`' if apt else ''))

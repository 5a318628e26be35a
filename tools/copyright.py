# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""ament_copyright, which knows long headers alone, with our two lines added: ``python -m tools.copyright PATH...``."""

import sys
from types import SimpleNamespace

from ament_copyright import get_licenses, main, parser  # type: ignore[import-not-found]

HEADER = '{copyright}\nSPDX-License-Identifier: Apache-2.0'


def licences() -> dict[str, object]:
    """Those of ament_copyright and ours, in the shape of its older and of its newer versions."""
    none = {**dict.fromkeys(('license_file', 'contributing_file'), ''), 'license_files': [], 'contributing_files': []}
    ours = SimpleNamespace(name='Apache-2.0 by SPDX', file_header=HEADER, file_headers=[HEADER], **none)
    return {**get_licenses(), 'spdx_apache2': ours}


if __name__ == '__main__':
    main.get_licenses = parser.get_licenses = licences
    sys.exit(main.main(sys.argv[1:]))

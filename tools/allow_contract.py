# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A contract of import-linter that lists what each room may import, instead of what it may not."""

from collections.abc import Iterable, Mapping

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output

PACKAGES = ('psd_deflection', 'msg_adapters')


class AllowContract(Contract):
    """Libraries that rooms may import."""

    type_name = 'allow'
    pure = fields.ListField(subfield=fields.StringField())
    rooms = fields.ListField(subfield=fields.StringField())

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        lines: dict[str, list[str]] = {}
        for line in _texts(self.rooms):
            room, _, libraries = line.partition(':')
            lines.setdefault(room, []).extend(libraries.split())
        broken = broken_by(imported(graph), set(_texts(self.pure)), lines)
        return ContractCheck(kept=not broken, metadata={'broken': broken})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for line in check.metadata['broken']:
            output.print_error(line)


def _texts(field: object) -> list[str]:
    """The values of a field, which its class declares as the field itself."""
    return [str(value) for value in field] if isinstance(field, Iterable) else []


def ours(module: str) -> bool:
    """Whether it belongs to the program."""
    return module.partition('.')[0] in PACKAGES


def imported(graph: ImportGraph) -> dict[str, set[str]]:
    """Each module of the program with the libraries that it imports itself."""
    modules = filter(ours, sorted(graph.modules))
    return {module: {m for m in graph.find_modules_directly_imported_by(module) if not ours(m)} for module in modules}


def broken_by(imports: Mapping[str, set[str]], pure: set[str], lines: Mapping[str, list[str]]) -> list[str]:
    """What of ``imports`` (module to libraries) the ``lines`` (room to libraries) do not allow."""
    out = []
    used: set[tuple[str, str]] = set()
    for module, libraries in imports.items():
        parts = module.split('.')
        above = ['.'.join(parts[:n]) for n in range(1, len(parts) + 1)]
        # The package's own line is for the package's own file.
        rooms = [r for r in above if r in lines and (r == module or r != PACKAGES[0])]
        if not rooms:
            out.append(f'{module}: no line for the room {".".join(parts[:2])}')
        for library in sorted(libraries - pure):
            holders = [room for room in rooms if library in lines[room]]
            used |= {(room, library) for room in holders}
            if not holders:
                out.append(f'{module} imports {library}, which no line allows there')
    for room, allowed in lines.items():
        if not any(m == room or m.startswith(room + '.') for m in imports):
            out.append(f'{room}: the line names no module')
            continue
        unused = [name for name in allowed if (room, name) not in used]
        out += [f'{room}: {name} is allowed, and nobody imports it' for name in unused]
    return out

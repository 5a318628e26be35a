"""diagnostic_msgs/DiagnosticArray: health, once a second."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from psd_deflection.records import DiagnosticEntry, DiagnosticReport

TYPE = 'diagnostic_msgs/msg/DiagnosticArray'


def from_report(report: DiagnosticReport) -> Fields:
    """Fields of one report."""
    return {
        'header': header(report.t_ns, ''),
        'status': [
            {
                'level': entry.level,
                'name': entry.name,
                'message': entry.message,
                'hardware_id': report.hardware_id,
                'values': [{'key': key, 'value': value} for key, value in entry.values],
            }
            for entry in report.entries
        ],
    }


def to_report(fields: Mapping[str, Any]) -> DiagnosticReport:
    """The record of a diagnostics message."""
    return DiagnosticReport(
        stamp_ns(fields),
        tuple(
            DiagnosticEntry(
                str(s['name']),
                int(s['level']),
                str(s['message']),
                tuple((str(v['key']), str(v['value'])) for v in s['values']),
            )
            for s in fields['status']
        ),
        next((str(s['hardware_id']) for s in fields['status']), ''),
    )

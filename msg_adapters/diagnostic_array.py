"""diagnostic_msgs/DiagnosticArray: health, once a second."""

from __future__ import annotations

from msg_adapters.header import Fields, header
from psd_deflection.records import DiagnosticReport

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

# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""diagnostic_msgs/DiagnosticArray: the diagnostics, once a second."""

from msg_adapters.header import Fields, header
from msg_adapters.message_type import MessageType
from psd_deflection.records import DiagnosticReport

MESSAGE = MessageType(
    'diagnostic_msgs/msg/DiagnosticArray',
    'RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e',
    'std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n',
    {
        'diagnostic_msgs/KeyValue': 'string key\nstring value\n',
        'diagnostic_msgs/DiagnosticStatus': (
            'byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n'
            'byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n'
        ),
    },
)


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

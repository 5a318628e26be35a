# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tables of references: read as they are written, rejected with file, line and value."""

from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import read_references, references_in
from test.recordings.making import write_bag

pytestmark = pytest.mark.slow


def written(folder: Path, text: str) -> Path:
    path = folder / 'camera.csv'
    path.write_text(text)
    return path


def test_frames_without_an_answer_are_counted_not_read(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        't,dx,dy,theta,sd_dx,sd_dy,sd_theta,status\n'
        '0.0334,1e-3,2e-3,0.01,1e-5,2e-5,1e-4,ok\n'
        '0.0667,,,,,,,blurred\n'
        '0.0001,0,0,0,1e-5,2e-5,1e-4,ok\n'
        '\n'
        '0.1,,,,,,,blurred\n',
    )
    references = read_references(path)
    assert references.t_ns.tolist() == [100_000, 33_400_000]
    assert references.poses.tolist() == [[0.0, 0.0, 0.0], [1e-3, 2e-3, 0.01]]
    assert references.sd is not None
    assert (references.sd[1].tolist(), references.rejected) == ([1e-5, 2e-5, 1e-4], {'blurred': 2})


def test_a_stage_needs_four_columns_only(tmp_path: Path) -> None:
    references = read_references(written(tmp_path, 'theta,t,dx,dy\n0.5,1,2,3\n'))
    assert references.poses.tolist() == [[2.0, 3.0, 0.5]]
    assert references.sd is None


def test_a_csv_recording_has_its_own(tmp_path: Path) -> None:
    rows = ['t,x1,y1,sum1,x2,y2,sum2,ref_dx,ref_dy,ref_theta']
    rows += [f'{i * 1e-3:.3f},0,0,5,0,0,5,' + ('1e-3,0,0' if i % 20 == 0 else ',,') for i in range(100)]
    references = read_references(written(tmp_path, '\n'.join(rows) + '\n'))
    assert np.allclose(references.t_ns, np.arange(0, 100, 20) * 1e6)
    assert references.poses[:, 0].tolist() == [1e-3] * 5


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('t,dx,dy\n0,0,0\n', r'camera\.csv:1: the header lacks theta'),
        ('t,dx,dy,theta\n0,0,zero,0\n', r"camera\.csv:2: column dy holds 'zero', which is not a number"),
        ('t,dx,dy,theta\n0,0,nan,0\n', r"camera\.csv:2: column dy holds 'nan', which is not finite"),
        ('t,dx,dy,theta\n1e300,0,0,0\n', r"camera\.csv:2: column t holds '1e300', which is beyond"),
        ('t,dx,dy,theta\n0,0,0\n', r'camera\.csv:2: has 3 cells, the header has 4'),
        ('t,dx,dy,theta,status\n0,,,,blurred\n', r'camera\.csv: holds no measurement with the status ok'),
        ('t,dx,dy,theta\n0,"0,0,0\n', r'camera\.csv:2: is no row of a CSV'),
        ('t,dx,dy,theta\n0,0,0,\xe9\n', r"column theta holds 'é', which is not a number"),
    ],
)
def test_a_fault_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        read_references(written(tmp_path, text))


def test_a_table_that_is_no_text_or_not_there_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / 'camera.csv'
    path.write_bytes(b't,dx,dy,theta\n0,0,0,\xff\xfe\n')
    with pytest.raises(RecordingError, match='is not text in UTF-8'):
        read_references(path)
    with pytest.raises(RecordingError, match='cannot be read'):
        read_references(tmp_path / 'none.csv')


def test_a_bag_states_the_deviations_of_each_reference(tmp_path: Path) -> None:
    write_bag(tmp_path / 'bag', {})
    references = references_in(open_recording(tmp_path / 'bag'))
    assert references is not None
    assert len(references.t_ns) == len(references.poses) >= 2
    assert references.sd is not None
    assert references.sd == pytest.approx(np.full((len(references.t_ns), 3), 1e-6))

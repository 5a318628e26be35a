# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The numbers that decide what is wrong with noted loads, and those that ``discover`` shares; below each its unit | its
reason | what it trades. ``python -m blind.sweep`` halves and doubles each.
"""

MANYFOLD = 10.0
"""factor | an order of magnitude: no size to first order is wrong by as much | false alarms against misses"""
PART = 0.2
"""share | a fifth of what was there, in amplitude 4 % of its energy | false alarms against misses"""
MINOR = 0.1
"""share | a tenth, in amplitude 1 % of its energy: next to nothing | false alarms against misses"""
SLIGHT = 0.05
"""share | as far as the numbers of a rig file are usually right | false alarms against misses"""
SAME = 0.02
"""share | an sd of 1250 values is as exact | time against precision"""
EXACT = 0.01
"""share | as far as weights are usually right | false alarms against misses"""
DISTINCT_SD = 3.0
"""sd | chance: 0.3 % of a normal law | false alarms against misses"""
OUTLIER_SD = 8.0
"""sd | a heavy tail (Student's t of 3 degrees) reaches it once in 250 values | lost samples against wrong ones"""
AS_GOOD = 2.0
"""factor | up to which what remains counts as equally good | wrong wirings against fewest changes"""
SIMULATION_ERROR = 0.002
"""share | of the movement, by which the simulation may be wrong | false alarms against misses"""
FEWEST_VALUES = 20
"""values | fewer tell an sd worse than to a sixth | misses against noise taken for motion"""
SEVERAL = 3
"""times | one or two may be mistakes of a person | misses against false alarms"""
FINE_SECONDS = 0.004
"""s | a twelfth of the period of torsion, 21 Hz | time against fast effects"""

REACH_S = 4.0
"""s | the next push, seconds later, may pass for this one | late clocks against wrong pushes"""
BRIEF_S = 0.1
"""s | a hand is no faster | steps against slow loads"""
APART_S = 0.25
"""s | a person notes no faster: changes in less are a sweep | sweeps against notes"""
ONE_DELAY_S = 0.9
"""s | the search fits one delay of all loads up to this | time against late loads"""
LATE_COST = 0.2
"""1/s | five seconds cost as a size that is wrong by 1.65 | wrong pairs against late notes"""
SKIP_STEP = 4.0
"""cost | two sd of a size; a note without a step costs three | missing notes against wrong pairs"""
ON_TIME_S = 0.03
"""s | chance puts a step so near to half of the notes once in a hundred recordings | late notes against false alarms"""
SWAY_HZ = (0.3, 6.0)
"""Hz | a pendulum of 2.8 m to one of 7 mm | swaying weights against drift and modes"""
REST_S = 0.5
"""s | the ringing of 14 Hz, damped by 0.02, has fallen by more than half | ringing against sway, misses"""
PLATE_M = 2e-7
"""m | noise of a block mean | detectors at fault against wrong notes"""
LONG_S = 1.0
"""s | a load held for less is a sweep | sweeps against loads held"""
FEWEST_LOADS = 4
"""loads | what effects do takes four numbers an axis | misses against false alarms"""
TOLERANCE = 0.3
"""N, N m | effects change loads by less, beyond a share (test/studies/loads/test_holds.py) | false alarms"""
ROUND_STEPS = (1.0, 2.0, 5.0, 10.0)
"""N, N m | to these people round loads | rounded loads against effects"""

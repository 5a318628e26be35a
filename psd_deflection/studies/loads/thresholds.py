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
"""share | estimates from 2500 values are as exact | time against precision"""
EXACT = 0.01
"""share | as far as weights are usually right | false alarms against misses"""
DISTINCT_SD = 3.0
"""sd | chance: 0.3 % of a normal law | false alarms against misses"""
OUTLIER_SD = 8.0
"""sd | heavy tails (Student's t, 3 degrees) reach it once in 500 values | lost samples against wrong ones"""
FEWEST_VALUES = 20
"""values | fewer tell an sd worse than to a sixth | misses against noise taken for motion"""
SEVERAL = 3
"""times | one or two may be mistakes of a person | misses against false alarms"""
FINE_SECONDS = 0.004
"""s | a tenth of the period of the fastest mode of bending | time against fast effects"""

REACH_S = 4.0
"""s | loggers hold readings back by less; half a change of the load by hand | time against late clocks"""
BRIEF_S = 0.1
"""s | a hand is no faster | steps against slow loads"""
APART_S = 0.25
"""s | a person notes no faster: changes in less are a sweep | sweeps against notes"""
FARTHEST_S = 30.0
"""s | a note so late belongs to another load | late notes against wrong pairs"""
ONE_DELAY_S = 0.9
"""s | the search fits one delay of all loads up to this | time against late loads"""
ALIKE_S = 0.002
"""s | half of a fine block | false alarms against late notes"""
BETTER = 4.0
"""factor | of energy, as twice the amplitude | false alarms against late notes"""
SETTLED = 5.0
"""time constants | less than a hundredth of the ringing remains | lost samples against ringing"""
LATE_COST = 0.2
"""1/s | a note is late by seconds | wrong pairs against late notes"""
SKIP_STEP = 4.0
"""cost | a step that nobody noted is likelier than a note without a step | missing notes against wrong pairs"""
ON_TIME_S = 0.03
"""s | chance puts a step so near to half of the notes once in a hundred recordings | late notes against false alarms"""
WHITE = 0.15
"""correlation | of neighbouring values, where 4 standard errors are less | motion against noise"""
SWAY_HZ = (0.3, 6.0)
"""Hz | a pendulum of 2.8 m to one of 7 mm | swaying weights against drift and modes"""
TONE = 0.25
"""share | of the frequency, in which half of a sway lies | swaying weights against steps"""
RINGS_S = 0.4
"""s | five periods of the bending | swaying weights against ringing"""
PLATE_M = 2e-7
"""m | noise of a block mean | detectors at fault against wrong notes"""
LONG_S = 1.0
"""s | a load held for less is a sweep | sweeps against loads held"""
FEWEST_LOADS = 4
"""loads | what effects do takes four numbers an axis | misses against false alarms"""
TOLERANCE = 0.3
"""N, N m | as test/studies/loads/test_holds.py: effects of the catalogue change loads by less | false alarms"""
CLOSE = 0.15
"""share | of the tolerance, where the other loads are so exact | false alarms against small mistakes"""
SOFTER = 0.1
"""share | sd of what effects do in proportion to loads | false alarms against misses"""
OFFSET = 0.5
"""N, N m | sd of what effects do at any load | false alarms against misses"""
DISTANT = 2.0
"""N, N m | a load off by more leaves the range in which dots are linear | time against misses"""
ROUND_STEPS = (1.0, 2.0, 5.0, 10.0)
"""N, N m | to these people round loads | rounded loads against effects"""

# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The numbers that decide what is named, beside those of :mod:`psd_deflection.studies.loads.thresholds`; below each its
unit | its reason | what it trades. ``python -m blind.sweep`` halves and doubles each.
"""

import numpy as np

P_LIBRARY = 1e-4
"""p | over the library: at 1e-3 one of 1000 recordings without fault had an effect | false alarms against misses"""
P_STRONG = 1e-3
"""p | one recording in a thousand | false alarms against misses"""
P_CHANCE = 0.01
"""p | of one question to one machine | false alarms against misses"""
BIC_GAIN = 10.0
"""BIC | very strong evidence (Kass and Raftery 1995) | false alarms against misses"""
BIC_EQUIVALENT = 6.0
"""BIC | strong evidence (Kass and Raftery 1995) | wrong names against open sets"""
SURE = 60.0
"""chi-square | its scatter of 2 sqrt(60) leaves ``EQUIVALENT`` | false alarms against misses"""
CERTAIN_SD = 5.0
"""sd | chance: 6e-7 of a normal law | false alarms against misses"""
ODDS = 20.0
"""odds | Markov: independent effects reach odds of N at most once in N searches | wrong causes against misses"""
DECADES = 2.0
"""decades | over which the ratio of two independent sizes spreads | wrong causes against misses"""
SIGNIFICANT = 1.5
"""floors | chance of so large a gap of 1 s (50 blocks of 4 dots): below 1e-20 | false alarms against misses"""
HALF = 0.5
"""share | the larger part of what an effect or a law explains | stand-ins against misses"""
LIKELY = 0.3
"""share | what a linear screen may miss of an effect that is far from linear | time against misses"""
MOST = 0.8
"""share | of what remains, or of a detector: most of it | false alarms against misses; time"""

CORNERS = np.geomspace(0.02, 200.0, 120)
"""Hz | 1/f noise of a lower corner is hidden, of a higher one it is all | time against precision"""
ORDER = 2
"""lags | a filter of second order | coloured noise against time"""
LEAST_REST = 400
"""values | standard error of a correlation: 0.05 | coloured noise against white"""
LINE = 40.0
"""factor | over the median power; chance: 1e-12 a bin | hum against noise"""

SMALL_MOVE = 1e-4
"""m, rad | movements up to it are in proportion to the load | precision against rounding"""
STUCK_S = 0.03
"""s | thirty samples of noise never have one count | lost samples against stuck channels"""
BANDS = (0.0, 2.0, 9.0, 17.0, 25.0, 60.0, 125.0)
"""Hz | drift, motion, bending, torsion, and beyond the means of blocks from 25 Hz | where structure shows"""
FEWEST_CASES = 8
"""parts | chance of eight alike: 0.4 % | misses against functions of noise"""
MOST_VALUES = 150
"""values | of a channel; time grows with their cube | time against functions"""
RANGE = (0.02, 20.0)
"""sd | of sizes and lengths: below it noise hides them, beyond it they are straight lines | overfit against misses"""
LEVELS = 24
"""values | over the whole range of a shape or threshold; terms, or loads, at most | time against misses"""

ROUNDS = 3
"""times | a fit beside better noise changes once or twice | time against misses"""
TRIALS = 7
"""effects | the right one is among so many to first order | time against misses"""
PAIRS = 5
"""pairs | are refitted, of a rough model three times as many | time against misses"""
MANY_EFFECTS = 4
"""effects, terms, turns | of four effects all are named in 38 of 40 cases (docs/blind.md) | time against stand-ins"""
TRIED = 12
"""terms, times | the right one of a law is among so many to first order | time against misses"""
FOLDS = 4
"""parts | left out in turn | time against precision"""
BUDGET = 700
"""simulations | for each effect; one takes 453 at most (docs/blind.md) | time against misses"""
PLANT_BUDGET = 4000
"""simulations | for each effect of a plant, whose simulation is fast | time against misses"""
MAX_FINE = 60_000
"""blocks | longer recordings get longer blocks | memory against fast effects"""
PASSES = 6
"""times | outliers next to each other show one after the other | time against outliers"""
OTHER_ERRORS = (-0.2, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.25)
"""share | starts from which a refit reaches any wrong rate or frequency of ringing | time against misses"""
STEP = 0.05
"""scale | of a finite difference | rounding against curvature"""
STOP = 0.05
"""chi-square | of an iteration | time against precision"""
DRAWS = 39
"""draws | of the largest cell; its law is Gumbel's | time against precision"""
ROUNDING = 1e-6
"""share | of a squared length; 32-bit signatures round to 1e-7 | directions that nothing determines"""
LEAST_LEVEL = 1e-9
"""share | of the largest reading: an exact simulation leaves rounding | overfit"""
UNKNOWN_SD = 1000.0
"""N, N m, quarters of a sample | sd of what nobody knows, also a pulse of one sample | precision against wrong loads"""
LEAST_REPORTED = (0.02, 0.02, 0.01)
"""N, N, N m | weights are no more exact | false alarms against small mistakes"""

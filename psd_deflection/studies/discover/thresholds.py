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
REPORTED_SD = 4.0
"""sd | chance: 6e-5 of a normal law, and a recording has tens of loads | false alarms against small mistakes"""
COLOURED_SD = 2.0
"""sd | the channels of a rig have like amplifiers | white noise against coloured"""
CLIP_SD = 6.0
"""sd | no value of normal noise in hours | false alarms of heavy tails against brief effects"""
ODDS = 20.0
"""odds | Markov: independent effects reach odds of N at most once in N searches | wrong causes against misses"""
DECADES = 2.0
"""decades | over which the ratio of two independent sizes spreads | wrong causes against misses"""
STAND_IN_ERROR = 0.003
"""share | a stand-in matches the true cause only approximately | wrong causes against misses"""
SIMULATION_ERROR = 0.002
"""share | of the movement, by which the simulation may be wrong | false alarms against misses"""
SIGNIFICANT = 1.5
"""floors | chance of a gap so large: below 1e-9 from ten blocks on | gaps reported as unknown against missed ones"""
HALF = 0.5
"""share | the larger part | stand-ins against misses"""
LIKELY = 0.3
"""share | what a linear screen may miss of an effect that is far from linear | time against misses"""
MOST = 0.8
"""share | a few readings reach no small p | false alarms against misses"""
SWAP = 0.6
"""share | screening is linear: a candidate may fall short by as much | time against wrong names"""
RINGING_SHARE = 0.005
"""share | another frequency explains little to first order | time against misses"""
EFFECT_ON_LOAD = 0.45
"""share | no effect of the catalogue changes a load by more | wrong notes against effects"""

HIGHEST_HZ = 20.0
"""Hz | above it slow noise is none | slow noise against modes"""
CORNERS = np.geomspace(0.02, 200.0, 120)
"""Hz | 1/f noise below is a constant, above it white | time against precision"""
CORNER_GAIN = 0.5
"""log-likelihood | a small corner that is none costs little, one that is missed makes a drift | slow noise, drift"""
WIDER = 1.3
"""factor | amplifiers are alike | slow noise against slow effects"""
APART = 4.0
"""factor | a light that differs more follows something | slow noise against slow effects"""
LEAST_VALUES = 64
"""values | a quarter of a second | short recordings against wrong corners"""
ORDER = 2
"""lags | a filter of second order | coloured noise against time"""
LEAST_REST = 400
"""values | standard error of a correlation: 0.05 | coloured noise against white"""
UNSURE = 0.03
"""share | of the estimated variance | detectors at fault against wrong notes"""
LINE = 40.0
"""factor | over the median power; chance: 1e-12 a bin | hum against noise"""

SMALL_MOVE = 1e-4
"""m, rad | dots are linear to 1e-3 | precision"""
LEAST_S = 0.0005
"""s | an eighth of a fine block | time against late loads"""
LARGEST_DELAY_S = 1.0
"""s | longer delays change loads by their number | time against late loads"""
STUCK_S = 0.03
"""s | noise changes the count of a converter at every second sample | lost samples against stuck channels"""
NEAR_S = 0.3
"""s | the link rings so long after a change of the load | laws of switching against noted loads"""
PIECE_SECONDS = 0.5
"""s | ringing is over: pieces are independent | false alarms against misses"""
BANDS = (0.0, 2.0, 9.0, 17.0, 25.0, 60.0, 125.0)
"""Hz | drift, motion, bending, torsion, and beyond the means of blocks from 25 Hz | where structure shows"""
FEWEST_CASES = 8
"""parts | chance of eight alike: 0.4 % | misses against functions of noise"""
MOST_VALUES = 150
"""values | of a channel; time grows with their cube | time against functions"""
SIZES = (0.05, 20.0)
"""sd | of a channel | overfit against misses"""
LENGTHS = (0.08, 8.0)
"""sd | of a variable | overfit against misses"""
NOISES = (0.02, 2.0)
"""sd | of a channel | overfit against misses"""
START = (1.0, 0.5, 0.5)
"""sd | size, length and noise that a fit begins with | time"""
LEVELS = 24
"""values | of a threshold or of terms | time against misses"""
VALLEYS = 49
"""values | shapes over their whole range | time against wrong shapes"""
TOGGLE_COST = 24.0
"""chi-square | twice the logarithm of the blocks of a recording, and some more | laws of switching"""

ROUNDS = 3
"""times | a fit beside better noise changes once or twice | time against misses"""
TRIALS = 7
"""effects | are refitted for the first place | time against misses"""
PAIRS = 5
"""pairs | are refitted, of a rough model three times as many | time against misses"""
MANY_EFFECTS = 4
"""effects | one machine has no more beyond those named | time against stand-ins"""
MOST_TERMS = 20
"""terms | that are counted in words | time"""
TRIED = 12
"""terms | of a law, or its times | time against misses"""
FOLDS = 4
"""parts | left out in turn | time against precision"""
TABLE_FOLDS = 6
"""parts | of a table | time against precision"""
BUDGET = 700
"""simulations | for each effect | time against misses"""
LAW_BUDGET = 600
"""simulations | beside one set of effects | time against misses"""
PLANT_BUDGET = 4000
"""simulations | for each effect of a plant, whose simulation is fast | time against misses"""
MAX_FINE = 60_000
"""blocks | longer recordings get longer blocks | memory against fast effects"""
BATCH = 64
"""terms | evaluated at a time | memory"""
MOST_MEASURED = 40
"""loads | measured ones of a recording whose errors are free; each takes three simulations | time against precision"""
PASSES = 6
"""times | outliers next to each other show one after the other | time against outliers"""
TURNS = 2
"""times | free loads, then sizes beside them | time against precision"""
OTHER_RATES = (-0.2, -0.1, -0.04, 0.04, 0.1, 0.25)
"""share | starts from which a refit reaches any wrong rate | time against misses"""
OTHER_FREQUENCIES = (-0.1, -0.05, -0.02, 0.02, 0.05, 0.1)
"""share | starts from which a refit reaches any wrong frequency | time against misses"""
FARTHEST_ERROR = -0.7
"""share | a linear step goes too far when readings are twice as large | misses"""
HALVED = -0.5
"""share | readings are twice as large | misses"""
STEP = 0.05
"""scale | of a finite difference | rounding against curvature"""
STOP = 0.05
"""chi-square | of an iteration | time against precision"""
BOOTSTRAPS = 400
"""draws | error of an sd: 3.5 % | time against precision"""
DRAWS = 39
"""draws | of the largest cell; its law is Gumbel's | time against precision"""
ROUNDING = 1e-6
"""share | of a squared length; 32-bit signatures round to 1e-7 | directions that nothing determines"""
ALIKE_SIGNATURES = 1e-5
"""sin² | what is left of 32-bit signatures is rounding | names against sets"""
LEAST_LEVEL = 1e-9
"""share | of the largest reading: an exact simulation leaves rounding | overfit"""
TINY = 1e-100
"""any | its square is above zero | none"""
FREE_MOMENTS = 40.0
"""quarters of a sample | sd of a fitted time: 10 samples | precision against wrong times"""
FREE = 100.0
"""N, N m | sd of a load that nobody knows | precision against wrong loads"""
PULSE = 1000.0
"""N, N m | sd of a load of one sample: a link of 14 Hz rings as after 90 N | precision against ringing"""
LEAST_REPORTED = (0.02, 0.02, 0.01)
"""N, N, N m | weights are no more exact | false alarms against small mistakes"""
WORTH_OF_PIECE = 0.02
"""value | of a further piece | time of a recording against its value"""
EFFORT_OF_A_MINUTE = 0.03
"""value | of a minute | time of a recording against its value"""
AS_GOOD = 2.0
"""factor | up to which what remains counts as equally good | wrong wirings against fewest changes"""
TERM_REACH = 20.0
"""sd | of an output, of the largest term | none"""

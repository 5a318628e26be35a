# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What does a block become? Samples to records, the same live and in replay.

The way of a block of n samples from P PSDs, with 2P readings. Blocks of one length are computed together: live mostly
one, in replay up to 50; no bit depends on that.

    pipeline.Pipeline.process      RawChunk -> volts (m, 3P)
    averaging.BlockCutter.add      -> SampleBlock: volts (n, 3P)
    pipeline.Pipeline._alike       model.detector: volts -> dots (n, 2P), m; correction: less the rig file's effects
    averaging.measured             -> BlockMeasures: means, covariance, sums of the samples
    health.OpticsHealth.classify   -> Verdict; with the dots it is an estimation.BlockInput
    estimation.Estimation.fit      uncertainty.block_fit (in its combinations) -> BlockReadings: dots at the block's
                                   timestamp (2P,), covariance (2P, 2P)
    estimation.Estimation.solve    solving: the primary solver; uncertainty.psd_set, consistency: the check; without a
                                   PSD that contradicts: fit and solve again -> BlockSolution
    pipeline.Pipeline._estimates   DeflectionEstimate out, then TipLoad, the motion filter's TipMotion (motion.motion,
                                   from the dots of all samples), the other solvers' estimates
    pipeline.Pipeline._learn       uncertainty.block_estimator.learn: noise, vibration; both count from the next block

State is what ``state_dict`` of a part says (:mod:`.state`); it changes in ``solve``, ``_estimates`` and ``_learn``.
"""

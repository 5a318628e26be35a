# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What does a block become? Samples to records, the same live and in replay.

The way of a block of n samples from P PSDs, with 2P readings. Blocks of one length are computed together: live mostly
one, in replay up to 50; no bit depends on that.

    pipeline.Pipeline.process      RawChunk -> volts (m, 3P)
    averaging.BlockCutter.add      -> SampleBlock: volts (n, 3P)
    pipeline.Pipeline._alike       model.detector: volts -> dots (n, 2P), m; correction: less the rig file's effects
    averaging.measured             -> BlockMeasures: means, scatter and sums of the samples
    health.OpticsHealth.classify   -> Verdict; with the dots it is an estimation.BlockInput
    estimation.Estimation.fit      uncertainty.block_fit, in its combinations -> BlockReadings: dots at the block's
                                   timestamp (2P,), their covariance C (2P, 2P) by the measured noise
    estimation.Estimation.solve    solving: the primary solver, weighted by the rig file's noise: pose, gain K (3, 2P);
                                   uncertainty.psd_set, consistency: the check, errors e that it allows for; without a
                                   PSD that is faulty or contradicts: fit and solve again -> BlockSolution
    pipeline.Pipeline._estimates   DeflectionEstimate to the sinks, then TipLoad, the filter's TipMotion (motion.motion,
                                   from the dots of all samples), the other solvers' estimates
    pipeline.Pipeline._learn       uncertainty.block_estimator.learn: noise, vibration; both count from the next block
    pipeline.Pipeline._findings    SpotMeans and the SampleBlock to the sinks

Covariance of the pose: K C K^T, plus (K F)(K F)^T for the calibration's uncertainty F F^T, plus the sum of
(K e_i)(K e_i)^T. State is what the parts' ``state_dict`` says (:mod:`.state`); ``fit`` changes none.
"""

"""The rig in numbers: load history to link, optics, detectors and electronics.

One way through, stage by stage, each vectorised over samples and free of noise until the last:
loads (``load``) -> static pose and modes (``link``) -> beams on the tip plate (``optics``) ->
detector response (``psd``) -> amplifier and converter (``electronics``). The nominal rig is the
thesis's own model; everything else is an *effect*, one file each in ``effects/``.
"""

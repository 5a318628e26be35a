"""The error budget of a rig: what each cause does to dX, dY and theta (thesis chapter 3, corrected).

``read_inputs`` and a rig make a ``Situation``; ``evaluate`` gives every cause and the totals to first
order, ``monte_carlo`` the same through the exact chain.
"""

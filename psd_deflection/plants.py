# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a machine that simulates itself is made of, for :func:`psd_deflection.discover_in`; these names stay here."""

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

__all__ = ['Effect', 'EffectParameter', 'Model', 'Plant', 'plant_effect']

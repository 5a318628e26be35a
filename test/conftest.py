"""No test asserts time, so hypothesis does not either; no test sees the effects of who runs it."""

import os

from hypothesis import settings

os.environ['PSD_DEFLECTION_EFFECTS'] = ''

settings.register_profile('untimed', deadline=None)
settings.load_profile('untimed')

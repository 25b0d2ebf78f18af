"""Time steps of simulation and control."""

TIMESTEP = 0.002  # [s] of one physics step
SUBSTEPS = 25  # physics steps per control step
CONTROL_PERIOD = SUBSTEPS * TIMESTEP  # 0.05 [s]
CONTROL_HZ = round(1.0 / CONTROL_PERIOD)  # 20 [Hz]

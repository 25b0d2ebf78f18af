"""The backend `warp`: many simulations of one model on a GPU, or on the processor for tests, by MuJoCo Warp.

Numbers are of single precision, except in the controller and in the sums of the arm's positions. The modules import
`warp` and `mujoco_warp`, which the extra `warp` installs.
"""

"""Sim-to-real for BALLU, a 0.29 kg biped held up by helium balloons, in MJX and Brax.

The package follows the order of Sontakke et al., "Residual Physics Learning and System Identification for
Sim-to-real Transfer of Policies on Buoyancy Assisted Legged Robots": recording, identification, residual,
policy, evaluation. Imports run one way along it.
"""

__version__ = "0.1.0"

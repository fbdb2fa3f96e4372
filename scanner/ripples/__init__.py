"""Bounces too weak for a pixel, found and taken off by the ripples that they draw on a surface.

A bounce of relative amplitude α moves a coordinate by up to α/(2πf): 0.02 is a weak one, below what the fringes of a
single pixel show, and moves it by 0.05 px, five times its noise. From pixel to pixel the distance Δu to the second path
changes, and the error goes up and down with it: z_t = B e^{i2πf_t u} (1 + α e^{i2πf_t Δu}).

In a window in which the surface is smooth and Δu runs evenly, what the *smooth* surface leaves of the phasors is a
plane wave α B e^{i2πf_t Δu}. Unlike the residual of a pixel's own fit (`scanner.pooling`) it still holds what that fit
would take for a shift. The wave is told from everything that the surface itself can do: relief shifts the fringes of
all frequencies alike, albedo scales them alike, creases and borders do both, and all of them therefore lie at Δu = 0;
over the frequencies the phase of a bounce turns by 2πΔf Δu. Only waves from a place well apart are taken off.

The test against noise is that of Kay, *Fundamentals of Statistical Signal Processing II: Detection Theory*, §7.6.
"""

from scanner.ripples.removal import compile_all, remove_ripples, shift_of

__all__ = ["compile_all", "remove_ripples", "shift_of"]

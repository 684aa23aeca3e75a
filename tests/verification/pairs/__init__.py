"""Pairs of pictures that a comparison must tell apart, and pairs that it must not: twelve scenes,
each drawn as it is and once per change, in two halves that share no head, camera or light. Whoever
changes the comparison looks at the half "tune"; the half "report" is for documents and tests.

A change that must fail counts where its effect is above what the encoding has of noise, and none
counts where the files hold the same pixels. The effect is the largest change of a colour of any
pixel: of EXR relative to the golden's radiance or to 0.01, whichever is more, and 0.5 % is noise;
of 8-bit images in steps of 255 before they are rounded, and 1 is noise.
"""

"""Pairs of images that a comparison must fail, and pairs that it must pass.

Each of twelve scenes is drawn unchanged and once per change. The scenes form two halves that share
no head, camera or light: tune the comparison only on the half "tune"; documents and tests use the
half "report".

The effect of a change is the largest change of a colour channel of any pixel. In EXR files it is
relative to the golden's radiance or to 0.01, whichever is more; up to 0.5 % is noise. In 8-bit
images it is in levels before rounding; up to 1 is noise. A change that must fail counts only if its
effect is above the noise of the encoding. No pair counts whose files hold the same pixels.
"""

"""Pairs of images that a comparison must fail, and pairs that it must pass.

Each scene is drawn unchanged and once per change. The scenes form three groups that share no head,
camera or light: tune the comparison only on the group "tune"; documents and tests use "report".
The limits never saw "judge": score it, and leave the limits alone.

The effect of a change is the largest change of a colour channel of any pixel. In EXR files it is
relative to the golden's radiance or to 0.01, whichever is more; up to 0.5 % is noise. In PNG files
it is in levels before rounding; up to 1 is noise. In JPEG files it is relative to the error of the
encoding (``draw.above_codec``); up to 1 is noise. A change that must fail counts only if its effect
is above the noise of the encoding. No pair counts whose files hold the same pixels.
"""

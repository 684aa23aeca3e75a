"""Images and animations: decoding, encoding, sRGB and colour profiles.

The package exists so that untrusted image files are checked in one place. Paths and bytes flow in,
:class:`ImageData` and bytes flow out. Rules: a size is checked before memory is allocated, and
equal pixels and metadata give equal bytes."""

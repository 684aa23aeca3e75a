"""The suite of image pairs as files, and the verdicts of facerender and other tools on them."""

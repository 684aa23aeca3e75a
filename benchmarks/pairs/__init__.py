"""The suite of image pairs as files, and how facerender and other tools judge them."""

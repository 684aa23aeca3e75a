"""What both the tests and the documents measure: cases of every shader function, the targets they
run on, renders broken on purpose, pairs of images, the scenes of the plans, and two heads."""

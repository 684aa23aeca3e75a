"""Values: ranges of fields, and checked vectors. A field states its range once, and every border
(constructor, file, option) checks against it."""

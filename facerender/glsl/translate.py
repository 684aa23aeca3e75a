"""Translation of GLSL functions and constants, with their comments, to HLSL, the Metal Shading
Language (MSL) and WGSL. Each language is a class, with tables of its type names and function
names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

from facerender.errors import InputError
from facerender.glsl.syntax import (
    MATRICES,
    SCALARS,
    SQUARE,
    VECTORS,
    Node,
    Parser,
    Part,
    Token,
    expanded,
)

# Words that GLSL allows as names, but that at least one of the other languages reserves.
_WORDS = """alias array as async auto await become binding buffer cast catch char class clip
        compile constant constexpr crate ddx ddy delete demote device dyn enum explicit
        export extends extern external final finally fma fn fragment friend from
        function get half handle impl implements import instanceof interface kernel lerp
        let line lineadj linear lit loop macro mad match matrix meta mod module move mul
        mut mutable namespace new nil noinline null of operator override package pass
        pixelfragment point precise premerge priv private protected ptr pub public rcp
        read ref regardless register requires resource rsqrt sample sampler saturate
        select self set shared short signed sizeof snorm static std string super target
        technique template texture thread threadgroup throw trait triangle try type
        typedef typename union unless unorm unsafe unsigned use using var vector vertex
        virtual volatile where with workgroup write yield"""
_RESERVED = frozenset(_WORDS.split())
# Built-in functions of WGSL that accept integers or bool.
_OF_ALL_SCALARS = ("abs", "sign", "min", "max", "clamp", "any", "all")


def translate(lines: Sequence[str], language: str) -> str:
    """Translate GLSL to another language.

    Parameters
    ----------
    lines : lines of functions, constants and macros, without conditionals
    language : one of LANGUAGES

    Raises
    ------
    InputError : samplers, arrays, structures, uniforms or other GLSL that is not supported; a
        construct that the other language lacks
    """
    parser = Parser(expanded(lines))
    program = parser.program()
    writer = LANGUAGES[language](parser)
    return writer.head + writer.joined(program)


class Writer:
    """Base class of the languages. The text of a node begins with the comments before it."""

    head = ""  # first lines of a file
    # Names in the target language, keyed by the GLSL name; equal names may be missing.
    types: ClassVar[Mapping[str, str]] = {}
    functions: ClassVar[Mapping[str, str]] = {}

    def __init__(self, parser: Parser) -> None:
        self._known = parser.functions
        self._function = ""

    def text(self, part: Part) -> str:
        if isinstance(part, Token):
            return part.before + self.word(part.text)
        self.check(part)
        write = getattr(self, f"write_{part.kind.replace('-', '_')}", None)
        return str(write(part)) if write else self.joined(part.parts)

    def joined(self, parts: Iterable[Part]) -> str:
        return "".join(map(self.text, parts))

    def check(self, node: Node) -> None:
        """Raise InputError with a construct and its types, such as "mat3(float)", that the target
        language lacks."""
        if self.lacks(node):
            types = [argument.type for argument in node.nodes]
            text = f" {node.sign} ".join(types if types[1:] else ["", *types])
            if node.kind in ("construct", "built-in", "call"):
                text = f"{node.name}({', '.join(types)})"
            elif node.kind == "variable":
                text = f"{node.type} {node.name} = {types[0]}"
            place = f"function {self._function}: " if self._function else ""
            text = re.sub(r"(\d)x\1", r"\1", text.strip())
            raise InputError(f"not translated: {place}{text}")

    def lacks(self, node: Node) -> bool:
        """Return whether the target language lacks the construct of a node."""
        types = [argument.type for argument in node.nodes]
        if node.kind == "construct":
            return not _constructs(node.type, types)
        if node.kind == "built-in":
            return node.name == "mix" and _scalar(types[2]) == "bool"
        return node.kind == "binary" and node.sign in ("==", "!=") and types[0] in MATRICES

    def bare(self, part: Part) -> str:
        """Return the text of a part without the comments and spaces before it."""
        return self.text(part)[len(part.before) :]

    def word(self, word: str) -> str:
        return self.types.get(word, f"{word}_" if word in _RESERVED else word)

    def splat(self, type_: str, text: str) -> str:
        """Return the text of a vector whose components all have the same value."""
        return f"{self.types[type_]}({text})"

    def write_built_in(self, node: Node) -> str:
        """Write a call of a built-in function. Scalars among vector arguments become vectors,
        except the third argument of mix."""
        arguments = node.nodes
        texts = [self.bare(argument) for argument in arguments]
        widest = next((argument.type for argument in arguments if argument.type in VECTORS), "")
        for i, argument in enumerate(arguments):
            if widest and argument.type in SCALARS and not (node.name == "mix" and i == 2):
                texts[i] = self.splat(widest, texts[i])
            elif "\n" in argument.before:
                texts[i] = argument.before + texts[i]
        name = "atan2" if node.name == "atan" and len(arguments) == 2 else node.name
        closing = node.parts[-1].before
        called = self.functions.get(name, name)
        return f"{node.before}{called}({_joined(texts)}{closing})"

    def write_binary(self, node: Node) -> str:
        left, sign, right = node.parts
        every = {"==": "all", "!=": "any"}.get(node.sign)
        if every and node.nodes[0].type in VECTORS:
            return f"{node.before}{every}({self.bare(left)}{self.text(sign)}{self.text(right)})"
        return self.joined(node.parts)


def _scalar(type_: str) -> str:
    """Return the type of the components of a type."""
    return "float" if type_ in MATRICES else VECTORS.get(type_, (type_,))[0]


def _constructs(type_: str, types: Sequence[str]) -> bool:
    """Return whether all languages construct a value of a type from values of these types."""
    counts = [0 if name in MATRICES else VECTORS.get(name, ("", 1))[1] for name in types]
    if type_ in MATRICES:
        columns, rows = MATRICES[type_]
        return counts in ([rows] * columns, [1] * (columns * rows)) or types == [type_]
    return counts == [1] or sum(counts) == VECTORS.get(type_, ("", 1))[1]


def _is_literal(node: Node) -> bool:
    """Return whether a node is a constant expression of integers, which WGSL converts."""
    inner = node.kind in ("group", "unary", "binary") and all(map(_is_literal, node.nodes))
    return node.type == "int" and (node.kind == "number" or inner)


def _joined(texts: Sequence[str]) -> str:
    """Join arguments with commas. An argument that begins on a new line stays on that line."""
    return "".join(
        ("," if text[:1] in "\n" else ", ") * bool(i) + text for i, text in enumerate(texts)
    )


def _spelled(form: Mapping[str, str], scalars: Mapping[str, str]) -> dict[str, str]:
    """Return the type names of the target language, keyed by the GLSL name of each type.

    form : format strings for "vector" and "matrix" types
    scalars : names of the scalar types, keyed by the GLSL name
    """
    vectors = {
        name: form["vector"].format(scalars[scalar], n) for name, (scalar, n) in VECTORS.items()
    }
    matrices = {name: form["matrix"].format(*sides) for name, sides in MATRICES.items()}
    squares = {name: matrices[full] for name, full in SQUARE.items()}
    return {**scalars, **vectors, **matrices, **squares}


class _CLike(Writer):
    """A language with C's syntax; `constant` is the qualifier of its global constants."""

    types = _spelled(
        {"vector": "{}{}", "matrix": "float{}x{}"}, {scalar: scalar for scalar in SCALARS}
    )
    constant: ClassVar[str]

    def write_constants(self, node: Node) -> str:
        word, *parts = map(self.text, node.parts)
        constant = word if self._function else node.before + self.constant
        return constant + "".join(parts)

    def write_construct(self, node: Node) -> str:
        arguments = node.nodes
        if node.name in VECTORS and len(arguments) == 1 and arguments[0].type in SCALARS:
            return node.before + self.splat(node.name, self.bare(arguments[0]))
        return self.joined(node.parts)

    def write_function(self, node: Node) -> str:
        self._function = node.name
        text = self.joined(node.parts)
        self._function = ""
        return text


class Hlsl(_CLike):
    """HLSL. A column of a GLSL matrix becomes a row of the HLSL matrix, so that [i] and
    constructors have the same meaning as in GLSL. Therefore matrix products reverse the order of
    their operands."""

    constant = "static const"
    functions: ClassVar[Mapping[str, str]] = {
        "mix": "lerp",
        "fract": "frac",
        "inversesqrt": "rsqrt",
        "dFdx": "ddx",
        "dFdy": "ddy",
    }

    def lacks(self, node: Node) -> bool:
        """HLSL multiplies the components in ``*=`` of matrices."""
        product = node.kind == "assign" and node.sign == "*="
        return (product and node.nodes[1].type in MATRICES) or super().lacks(node)

    def splat(self, type_: str, text: str) -> str:
        return f"(({self.types[type_]})({text}))"

    def write_binary(self, node: Node) -> str:
        left, _, right = node.parts
        types = {operand.type for operand in node.nodes}
        if node.sign == "*" and types & {*MATRICES} and not types & {*SCALARS}:
            return f"{node.before}mul({self.bare(right)}, {self.bare(left)})"
        return super().write_binary(node)


class Msl(_CLike):
    constant = "constant"
    head = "#include <metal_stdlib>\nusing namespace metal;\n\n"
    functions: ClassVar[Mapping[str, str]] = {
        "inversesqrt": "rsqrt",
        "dFdx": "dfdx",
        "dFdy": "dfdy",
    }

    def write_in(self, node: Node) -> str:
        return f"{node.before}{self.types[node.type]} {self.word(node.name)}"

    def write_out(self, node: Node) -> str:
        return f"{node.before}thread {self.types[node.type]} &{self.word(node.name)}"

    write_inout = write_out


class Wgsl(Writer):
    types = _spelled(
        {"vector": "vec{1}{0[0]}", "matrix": "mat{}x{}f"},
        {"float": "f32", "int": "i32", "uint": "u32", "bool": "bool"},
    ) | {f"bvec{n}": f"vec{n}<bool>" for n in (2, 3, 4)}
    functions: ClassVar[Mapping[str, str]] = {
        "inversesqrt": "inverseSqrt",
        "dFdx": "dpdx",
        "dFdy": "dpdy",
    }

    def __init__(self, parser: Parser) -> None:
        super().__init__(parser)
        self._pointers: set[str] = set()
        self._assigned: set[str] = set()

    def lacks(self, node: Node) -> bool:
        operands, category, sign = node.nodes, node.kind, node.sign.removesuffix("=")
        if category == "call":
            parameters = [_scalar(type_) for _, type_, _ in self._known[node.name].parameters]
            return any(
                not _is_literal(operand) and _scalar(operand.type) != scalar
                for operand, scalar in zip(operands, parameters, strict=False)
            )
        operands = operands[category == "ternary" :]
        types = {operand.type for operand in operands}
        if category in ("unary", "prefix", "postfix", "ternary") and types & {*MATRICES}:
            return True
        if category == "unary" and sign == "+":
            return True
        if types & {*MATRICES} and (sign == "/" or (sign in ("+", "-") and types & {*SCALARS})):
            return True
        # WGSL has no implicit conversions, except of literals.
        scalars = {_scalar(operand.type) for operand in operands if not _is_literal(operand)}
        explicit = node.type in SCALARS or (len(operands) == 1 and types & {*VECTORS})
        if category == "variable" or (category == "construct" and not explicit):
            scalars.add(_scalar(node.type))
        elif category == "return" and operands:
            scalars.add(_scalar(self._known[self._function].type))
        elif category == "built-in" and node.name not in _OF_ALL_SCALARS:
            scalars.add("float")
        elif category not in ("binary", "assign", "ternary", "built-in") or sign in ("<<", ">>"):
            scalars.clear()
        return len(scalars) > 1 or super().lacks(node)

    def write_name(self, node: Node) -> str:
        name = self.word(node.name)
        return node.before + (f"(*{name})" if node.name in self._pointers else name)

    def write_prototype(self, node: Node) -> str:
        return node.before.rstrip(" \n")

    def write_function(self, node: Node) -> str:
        function = self._known[node.name]
        self._function = node.name
        self._pointers = {name for qualifier, _, name in function.parameters if qualifier != "in"}
        self._assigned = function.assigned
        parameters: list[str] = []
        copies = []
        for part in node.nodes[:-1]:
            name, type_ = self.word(part.name), self.types[part.type]
            if part.kind != "in":
                type_ = f"ptr<function, {type_}>"
            elif part.name in function.assigned:
                copies.append(f"\n    var {name} = {name}_given;")
                name += "_given"
            gap = part.before
            parameters.append(f"{gap if chr(10) in gap else ' ' * bool(parameters)}{name}: {type_}")
        body = self.text(node.parts[-1])
        start = body.index("{") + 1
        gap = node.parts[-2].before
        result = "" if node.type == "void" else f" -> {self.types[node.type]}"
        self._pointers, self._assigned, self._function = set(), set(), ""
        head = f"{node.before}fn {self.word(node.name)}({','.join(parameters)}{gap}){result}"
        return head + body[:start] + "".join(copies) + body[start:]

    def write_constants(self, node: Node) -> str:
        return self.write_variables(node, "let" if self._function else "const")

    def write_variables(self, node: Node, fixed: str = "let") -> str:
        """Write a declaration for each variable. Variables that are never reassigned are declared
        with `fixed`."""
        texts = []
        for part in node.nodes:
            self.check(part)
            text = self.joined(part.parts[1:])
            word = "var" if part.name in self._assigned or not text else fixed
            implied = word == "let" and [value.type for value in part.nodes] == [part.type]
            type_ = "" if implied else f": {self.types[part.type]}"
            texts.append(f"{word} {self.word(part.name)}{type_}{text};")
        return node.before + " ".join(texts)

    def write_ternary(self, node: Node) -> str:
        condition, _, if_true, _, if_false = (self.bare(part) for part in node.parts)
        return f"{node.before}select({if_false}, {if_true}, {condition})"

    def write_postfix(self, node: Node) -> str:
        """Write ++ or --. WGSL has them only for integers, so other types add or subtract 1.0."""
        (operand,) = node.nodes
        if operand.type in ("int", "uint"):
            return node.before + self.bare(operand) + node.sign
        step = Node("number", [Token("number", "1.0", " ")], "float")
        sign = Token("sign", f"{node.sign[0]}=", " ")
        return node.before + self.bare(Node("assign", [operand, sign, step], operand.type))

    write_prefix = write_postfix

    def write_call(self, node: Node) -> str:
        texts = []
        parameters = self._known[node.name].parameters
        for argument, (qualifier, _, _) in zip(node.nodes, parameters, strict=False):
            gap = argument.before if "\n" in argument.before else ""
            texts.append(f"{gap}{'&' * (qualifier != 'in')}{self.bare(argument)}")
        closing = node.parts[-1].before
        return f"{node.before}{self.word(node.name)}({_joined(texts)}{closing})"

    def write_assign(self, node: Node) -> str:
        target, sign, value = node.parts
        if not (isinstance(target, Node) and target.kind == "swizzle" and len(target.name) > 1):
            return self.joined(node.parts)
        vector, text, operator = (self.bare(part) for part in (target.parts[0], value, sign))
        if operator != "=":
            text = f"{self.bare(target)} {operator[:-1]} ({text})"
        parts = " ".join(
            f"{vector}.{component} = parts.{'xyzw'[i]};" for i, component in enumerate(target.name)
        )
        return f"{node.before}{{ let parts = {text}; {parts} }}"

    def write_expression(self, node: Node) -> str:
        text = self.text(node.parts[0])
        return text if text.endswith("}") else text + self.text(node.parts[1])

    def _braced(self, part: Part) -> str:
        if isinstance(part, Token) or part.kind == "block":
            return self.text(part)
        text = self.text(part) if "\n" in part.before else f" {self.bare(part)}"
        return f" {{{text} }}"

    def write_if(self, node: Node) -> str:
        parts = node.parts
        text = self.joined(parts[:4]) + self._braced(parts[4])
        if len(parts) > 5:
            branch = parts[6]
            chained = isinstance(branch, Node) and branch.kind == "if"
            text += self.text(parts[5]) + (self.text(branch) if chained else self._braced(branch))
        return text

    def write_for(self, node: Node) -> str:
        head = node.parts[2]
        if isinstance(head, Node) and head.kind == "variables" and len(head.nodes) > 1:
            raise InputError("not translated: several variables in the head of for")
        return self.joined(node.parts[:-1]) + self._braced(node.parts[-1])

    write_while = write_for

    def write_binary(self, node: Node) -> str:
        left, _, right = node.parts
        if node.sign in ("<<", ">>"):
            return f"{self.text(left)} {node.sign} u32({self.bare(right)})"
        if node.sign == "^^":
            return f"{self.text(left)} !={self.text(right)}"
        return super().write_binary(node)


LANGUAGES: dict[str, type[Writer]] = {"hlsl": Hlsl, "msl": Msl, "wgsl": Wgsl}

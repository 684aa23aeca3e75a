"""A small GLSL parser for functions and constants.

The syntax tree stores the type of each expression. Each token includes the comments and spaces
before it, so that the tokens of the tree give the source text. ``translate.py`` translates the
tree."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

from facerender.errors import InputError

_TOKEN = re.compile(
    r"(?P<space>(?:\s|//[^\n]*|/\*.*?\*/)+)"
    r"|(?P<number>(?:(?:\d+\.\d*|\.\d+)(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)[fF]?|0[xX][\da-fA-F]+[uU]?|\d+[uU]?)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<sign>\+\+|--|<<=|>>=|<<|>>|[-+*/%&|^<>=!]=|&&|\|\||\^\^|[-+*/%<>=!&|^~?:;,.(){}\[\]#])"
    r"|(?P<other>.)",
    re.DOTALL,
)
_DIRECTIVE = re.compile(r"[ \t]*#[ \t]*(\w+)[ \t]*(.*)")
_DEFINE = re.compile(r"(\w+)(?:\(([^)]*)\))?[ \t]*(.*)")
_NUMBER = re.compile(r"\(?(-?(?:[\d.]+(?:[eE][-+]?\d+)?))\)?")

_PREFIXES = {"float": "", "int": "i", "uint": "u", "bool": "b"}  # of vectors
SCALARS = (*_PREFIXES,)
VECTORS = {
    f"{prefix}vec{n}": (scalar, n) for scalar, prefix in _PREFIXES.items() for n in (2, 3, 4)
}
MATRICES = {f"mat{c}x{r}": (c, r) for c in (2, 3, 4) for r in (2, 3, 4)}
SQUARE = {f"mat{n}": f"mat{n}x{n}" for n in (2, 3, 4)}
TYPES = {*SCALARS, *VECTORS, *MATRICES, *SQUARE}
QUALIFIERS = {"const", "in"}

# Return types of built-in functions: a type, or "widest" for the type of the widest argument.
RESULTS = {
    **dict.fromkeys(["abs", "sign", "floor", "ceil", "fract", "min", "max", "clamp"], "widest"),
    **dict.fromkeys(["sqrt", "inversesqrt", "exp", "exp2", "log", "log2", "pow"], "widest"),
    **dict.fromkeys(["sin", "cos", "tan", "asin", "acos", "atan"], "widest"),
    **dict.fromkeys(["mix", "step", "smoothstep", "normalize", "cross", "reflect"], "widest"),
    **dict.fromkeys(["dFdx", "dFdy", "fwidth"], "widest"),
    **dict.fromkeys(["dot", "length", "distance"], "float"),
    **dict.fromkeys(["any", "all"], "bool"),
}
# Binary operators, from lowest to highest precedence.
_LEVELS = [["||"], ["^^"], ["&&"], ["|"], ["^"], ["&"], ["==", "!="], ["<", ">", "<=", ">="],
           ["<<", ">>"], ["+", "-"], ["*", "/", "%"]]  # fmt: skip
_COMPONENTS = str.maketrans("stpqrgba", "xyzwxyzw")
_ASSIGN = {"=", "+=", "-=", "*=", "/=", "%=", "&=", "|=", "^=", "<<=", ">>="}
_STEP = {"++", "--"}
_OTHER_STATEMENTS = {"do", "switch", "case", "default", "discard"}


@dataclass(frozen=True)
class Token:
    kind: str  # "number", "name", "sign" or "end".
    text: str
    before: str = ""  # Comments and spaces before the token.


Part: TypeAlias = "Token | Node"


@dataclass
class Node:
    """A node of the syntax tree."""

    kind: str  # such as "call", "ternary" or "if"
    parts: list[Part]  # in source order
    type: str = ""  # of an expression, variable, parameter or result; matrices are written matCxR
    name: str = ""  # of a call, function, variable or parameter, or the components of a swizzle

    @property
    def before(self) -> str:
        """Comments and spaces before the node."""
        return self.parts[0].before

    @property
    def nodes(self) -> list[Node]:
        """The child nodes, such as the arguments of a call."""
        return [part for part in self.parts if isinstance(part, Node)]

    @property
    def sign(self) -> str:
        """The first token, such as the operator of an expression."""
        return next((part.text for part in self.parts if isinstance(part, Token)), "")


@dataclass
class Function:
    """The signature of a function."""

    type: str  # return type
    parameters: list[tuple[str, str, str]]  # qualifier, type and name
    assigned: set[str] = field(default_factory=set)  # variables that the body assigns


def tokens(text: str) -> list[Token]:
    """Split text into tokens. Raise InputError for a character that GLSL does not allow."""
    result, space = [], ""
    for match in _TOKEN.finditer(text):
        token_type, word = str(match.lastgroup), match[0]
        if token_type == "other":
            raise InputError(f"not translated: {word!r} is not a character of GLSL")
        if token_type == "space":
            space = word
            continue
        text = _number(word) if token_type == "number" else word
        result.append(Token(token_type, text, space))
        space = ""
    result.append(Token("end", "", space))
    return result


def _number(text: str) -> str:
    """Return a number as all languages write it: not octal, without the suffixes f, F and U."""
    digits = text.rstrip("uU")
    if re.fullmatch("0[0-7]+", digits):
        digits = str(int(digits, 8))
    elif "x" not in digits.lower():
        digits = digits.rstrip("fF")
    return digits + "u" * (text[-1] in "uU")


_Macro = tuple[list[str] | None, list[Token]]  # parameters, body


def expanded(lines: Sequence[str]) -> list[Token]:
    """Expand the macros in lines that contain no conditionals, and return the tokens. A macro whose
    value is a number becomes the declaration of a constant."""
    macros: dict[str, _Macro] = {}
    result: list[Token] = []
    chunk: list[str] = []

    def flush() -> None:
        *code, end = tokens("\n".join(chunk))
        result.extend(_replaced(code, macros))
        chunk[:] = [end.before]

    for line in lines:
        match = _DIRECTIVE.fullmatch(line)
        if match is None:
            chunk.append(line)
            continue
        directive, content = match[1], re.sub(r"\s*//.*|/\*.*?\*/", "", match[2]).strip()
        if directive not in ("define", "undef", "line", "version"):
            raise InputError(f"not translated: {line.strip()}: remove the line")
        define = _DEFINE.fullmatch(content) if directive in ("define", "undef") else None
        if define is None:
            continue
        name, parameters, body = define[1], define[2], define[3]
        if parameters is None and (number := _NUMBER.fullmatch(body)) and directive == "define":
            number_type = "int" if number[1].lstrip("-").isdigit() else "float"
            chunk.append(f"const {number_type} {name} = {number[1]};")
            continue
        flush()
        macros.pop(name, None)
        if directive == "define":
            names = None if parameters is None else [*map(str.strip, parameters.split(","))]
            macros[name] = names, tokens(body)[:-1]
    flush()
    return list(_exact([*result, Token("end", "", chunk[0])]))


def _exact(code: Sequence[Token]) -> Iterator[Token]:
    """Yield the tokens without precision qualifiers and precision statements."""
    space, statement = "", False
    for token in code:
        statement |= token.text == "precision"
        if statement or token.text in ("highp", "mediump", "lowp"):
            space = space or token.before
            statement &= token.text != ";"
        else:
            token_type = "name" if token.kind == "final name" else token.kind
            yield replace(token, kind=token_type, before=space or token.before)
            space = ""


def _replaced(
    code: Sequence[Token], macros: dict[str, _Macro], within: frozenset[str] = frozenset()
) -> list[Token]:
    result: list[Token] = []
    index = 0
    while index < len(code):
        token, index = code[index], index + 1
        macro = macros.get(token.text) if token.kind == "name" else None
        called = index < len(code) and code[index].text == "("
        if macro and token.text in within:
            token, macro = replace(token, kind="final name"), None  # never expanded again
        if macro is None or (macro[0] is not None and not called):
            result.append(token)
            continue
        parameters, body = macro
        if parameters is not None:
            arguments, index = _arguments(code, index)
            arguments = [_replaced(argument, macros, within) for argument in arguments]
            values = dict(zip(parameters, arguments, strict=False))
            body = [part for word in body for part in _with(values.get(word.text, [word]), word)]
        if len(body) == 3 and (body[0].text, body[2].text) == ("(", ")"):
            body = body[1:2]
        result += _with(_replaced(body, macros, within | {token.text}), token)
    return result


def _with(code: Sequence[Token], place: Token) -> list[Token]:
    """Return tokens with the comments and spaces of `place` in front of the first token."""
    return [
        replace(token, before=token.before if i else place.before) for i, token in enumerate(code)
    ]


def _arguments(code: Sequence[Token], index: int) -> tuple[list[list[Token]], int]:
    """Return the arguments of a macro call, whose opening parenthesis has an index, and the index
    of the token after the call."""
    arguments: list[list[Token]] = [[]]
    depth = 0
    while index < len(code):
        token, index = code[index], index + 1
        depth += (token.text in "([") - (token.text in ")]")
        if depth == 0:
            break
        if depth == 1 and token.text == ",":
            arguments.append([])
        elif depth > 1 or token.text != "(":
            arguments[-1].append(token)
    return arguments, index


class Parser:
    """Parser of functions and constants."""

    def __init__(self, code: list[Token]) -> None:
        self._code, self._at = code, 0
        self._scopes: list[dict[str, str]] = [{}]
        self.functions: dict[str, Function] = {}  # Signatures of the parsed functions, by name.
        self._function = Function("", [])
        self._name = ""  # The function that is parsed, for messages.
        self._conditions = 0  # Number of enclosing ?:, && and || expressions.

    def program(self) -> list[Node]:
        """Return the declarations; the last node holds the comments and spaces after the last
        declaration. Raise InputError for GLSL that is not supported."""
        nodes = []
        while self._next.kind != "end":
            nodes.append(self._declaration())
        return [*nodes, Node("end", [self._next])]

    @property
    def _next(self) -> Token:
        return self._code[self._at]

    def _take(self, *expected: str) -> Token:
        token = self._next
        if token.kind == "end":
            raise self._error("the text ends too early")
        if expected and token.text == "," and "," not in expected:
            raise self._error("the comma operator")
        if expected and token.text not in expected:
            raise self._error(f"{' or '.join(expected)} is missing before {token.text!r}")
        self._at += 1
        return token

    def _error(self, message: str) -> InputError:
        place = f"function {self._name}: " if self._name else ""
        return InputError(f"not translated: {place}{message}")

    def _refuse_array(self) -> None:
        if self._next.text == "[":
            raise self._error("an array; only numbers, vectors and matrices are supported")

    def _type(self) -> str:
        token = self._take()
        if token.text not in TYPES:
            raise self._error(
                f"{token.text!r}; only functions and constants of numbers, vectors and matrices "
                "are supported"
            )
        self._refuse_array()
        return SQUARE.get(token.text, token.text)

    def _declaration(self) -> Node:
        start, self._name = self._at, ""
        if self._next.text == "const":
            return self._variables()
        type_ = "void" if self._next.text == "void" and self._take() else self._type()
        name = self._take()
        if name.kind != "name" or self._next.text != "(":
            raise self._error(f"{name.text!r}; only functions and constants are supported")
        self._name = name.text
        self._take("(")
        parameters: list[Part] = []
        function = Function(type_, [])
        if self._next.text == "void":
            parameters.append(self._take())
        while self._next.text != ")":
            first, qualifier = self._at, "in"
            while self._next.text in QUALIFIERS | {"out", "inout"}:
                word = self._take().text
                qualifier = word if word in ("out", "inout") else qualifier
            parameter_type = self._type()
            if self._next.kind != "name":
                raise self._error("a parameter without a name")
            parameter = self._take().text
            self._refuse_array()
            function.parameters.append((qualifier, parameter_type, parameter))
            parameters.append(
                Node(qualifier, list(self._code[first : self._at]), parameter_type, parameter)
            )
            if self._next.text == ",":
                parameters.append(self._take())
        head: list[Part] = [*self._code[start : start + 3], *parameters, self._take(")")]
        self._add(name.text, function)
        if self._next.text == ";":
            return Node("prototype", [*head, self._take()], type_, name.text)
        self._scopes.append({name: type_ for _, type_, name in function.parameters})
        self._function = function
        body = self._block()
        self._scopes.pop()
        return Node("function", [*head, body], type_, name.text)

    def _add(self, name: str, function: Function) -> None:
        """Store the signature of a function or prototype."""
        declared = self.functions.setdefault(name, function)
        types = [[type_ for _, type_, _ in f.parameters] for f in (declared, function)]
        if types[0] != types[1]:
            raise self._error(f"an overload of the function {name!r}: give it another name")
        self.functions[name] = function

    # --- statements ---

    def _block(self) -> Node:
        parts: list[Part] = [self._take("{")]
        self._scopes.append({})
        while self._next.text != "}":
            parts.append(self._statement())
        self._scopes.pop()
        return Node("block", [*parts, self._take("}")])

    def _statement(self) -> Node:
        word = self._next.text
        if word == "{":
            return self._block()
        parts: list[Part]
        if word == "if":
            parts = [self._take(), self._take("("), self._expression(), self._take(")")]
            parts.append(self._statement())
            if self._next.text == "else":
                parts += [self._take(), self._statement()]
            return Node("if", parts)
        if word == "for":
            self._scopes.append({})
            parts = [self._take(), self._take("(")]
            if self._next.text not in QUALIFIERS | TYPES:
                raise self._error("for without a declaration in its head")
            parts.append(self._variables())
            parts += [self._expression(), self._take(";"), self._changed(), self._take(")")]
            step = parts[5]
            if isinstance(step, Node) and any(map(_several, step.parts[:2])):
                raise self._error(
                    "several components of a vector assigned in the head of for: use its body"
                )
            parts.append(self._statement())
            self._scopes.pop()
            return Node("for", parts)
        if word == "while":
            parts = [self._take(), self._take("("), self._expression(), self._take(")")]
            return Node("while", [*parts, self._statement()])
        if word == "return" and self._code[self._at + 1].text != ";":
            return Node("return", [self._take(), self._expression(), self._take(";")])
        if word in ("return", "break", "continue"):
            return Node(word, [self._take(), self._take(";")])
        if word in QUALIFIERS or (word in TYPES and self._code[self._at + 1].kind == "name"):
            return self._variables()
        if word in _OTHER_STATEMENTS:
            raise self._error(f"{word!r}; only if, for and while are supported")
        if word == ";":
            raise self._error("an empty statement")
        return Node("expression", [self._changed(), self._take(";")])

    def _variables(self) -> Node:
        """Parse a declaration. The parts of its node are tokens and one node for each variable. A
        variable's node contains the name and, if there is one, the value."""
        start = self._at
        constant = False
        while self._next.text in QUALIFIERS:
            constant |= self._take().text == "const"
        type_ = self._type()
        parts: list[Part] = list(self._code[start : self._at])
        while True:
            name = self._take()
            variable_parts: list[Part] = [name]
            self._refuse_array()
            if self._next.text == "=":
                variable_parts += [self._take(), self._expression()]
            self._scopes[-1][name.text] = type_
            parts += [Node("variable", variable_parts, type_, name.text), self._take(",", ";")]
            if self._code[self._at - 1].text == ";":
                return Node("constants" if constant else "variables", parts, type_)

    # --- expressions ---

    def _changed(self) -> Node:
        """Parse an expression that is a statement.

        Other expressions may not assign: WGSL allows no assignments within expressions, and HLSL
        evaluates both operands of ``&&`` and ``||``.
        """
        if self._next.text in _STEP:
            sign, operand = self._take(), self._unary()
            self._assign(operand)
            return Node("prefix", [sign, operand], operand.type)
        expression = self._ternary()
        if expression.kind in ("name", "swizzle", "index") and self._next.text in _ASSIGN | _STEP:
            self._assign(expression)
            if self._next.text in _STEP:
                return Node("postfix", [expression, self._take()], expression.type)
            return Node("assign", [expression, self._take(), self._expression()], expression.type)
        return expression

    def _expression(self) -> Node:
        """Parse an expression that itself assigns nothing; functions that it calls may assign."""
        expression = self._ternary()
        if self._next.text in _ASSIGN | _STEP:
            raise self._within(self._next.text)
        return expression

    def _within(self, message: str) -> InputError:
        return self._error(f"{message!r} within an expression: write a separate statement")

    def _assign(self, node: Node) -> None:
        """Record that a variable, or a component of it, is assigned."""
        while isinstance(node.parts[0], Node):
            node = node.parts[0]
        self._function.assigned.add(node.name)

    def _ternary(self) -> Node:
        condition = self._binary(0)
        if self._next.text != "?":
            return condition
        self._conditions += 1
        question, if_true = self._take(), self._expression()
        colon, if_false = self._take(":"), self._ternary()
        self._conditions -= 1
        type_ = _product(question.text, if_true.type, if_false.type)
        return Node("ternary", [condition, question, if_true, colon, if_false], type_)

    def _binary(self, level: int) -> Node:
        if level == len(_LEVELS):
            return self._unary()
        left = self._binary(level + 1)
        while self._next.text in _LEVELS[level]:
            sign = self._take()
            self._conditions += sign.text in ("&&", "||")
            right = self._binary(level + 1)
            self._conditions -= sign.text in ("&&", "||")
            type_ = (
                "bool" if level in (0, 1, 2, 6, 7) else _product(sign.text, left.type, right.type)
            )
            left = Node("binary", [left, sign, right], type_)
        return left

    def _unary(self) -> Node:
        if self._next.text in ("-", "+", "!", "~"):
            sign, operand = self._take(), self._unary()
            return Node("unary", [sign, operand], operand.type)
        if self._next.text in _STEP:
            raise self._within(self._next.text)
        node = self._primary()
        while self._next.text in (".", "["):
            if self._next.text == "[":
                if node.type not in VECTORS and node.type not in MATRICES:
                    raise self._error(f"'[' of a {node.type}")
                scalar, count = VECTORS.get(node.type, ("float", 0))
                type_ = scalar if count else _vector(scalar, MATRICES[node.type][1])
                parts: list[Part] = [node, self._take(), self._expression(), self._take("]")]
                node = Node("index", parts, type_)
            else:
                dot, field_ = self._take(), self._take()
                components = field_.text.translate(_COMPONENTS)
                if node.type not in VECTORS or not re.fullmatch("[xyzw]{1,4}", components):
                    raise self._error(f"{field_.text!r} of a {node.type}")
                field_ = replace(field_, text=components)
                scalar, count = VECTORS[node.type][0], len(components)
                node = Node("swizzle", [node, dot, field_], _vector(scalar, count), field_.text)
        return node

    def _primary(self) -> Node:
        token = self._take()
        if token.kind == "number":
            floats = "." in token.text or ("e" in token.text.lower() and "x" not in token.text)
            number_type = "float" if floats else "uint" if token.text.endswith("u") else "int"
            return Node("number", [token], number_type)
        if token.text == "(":
            inner = self._expression()
            return Node("group", [token, inner, self._take(")")], inner.type)
        if token.text in ("true", "false"):
            return Node("number", [token], "bool")
        if token.kind != "name":
            raise self._error(f"{token.text!r}")
        if token.text in TYPES:
            self._refuse_array()
        if self._next.text == "(":
            return self._call(token)
        for scope in reversed(self._scopes):
            if token.text in scope:
                return Node("name", [token], scope[token.text], token.text)
        raise self._error(f"{token.text!r} is not declared")

    def _call(self, name: Token) -> Node:
        parts: list[Part] = [name, self._take("(")]
        while self._next.text != ")":
            parts.append(self._expression())
            if self._next.text == ",":
                parts.append(self._take())
        parts.append(self._take(")"))
        arguments = Node("call", parts).nodes
        type_ = SQUARE.get(name.text, name.text)
        if type_ in TYPES:
            return Node("construct", parts, type_, type_)
        if name.text in self.functions:
            function = self.functions[name.text]
            for argument, (qualifier, _, _) in zip(arguments, function.parameters, strict=False):
                if qualifier == "in":
                    continue
                if argument.kind != "name":
                    raise self._error(f"an output argument of {name.text}: give a whole variable")
                if self._conditions:
                    raise self._error(
                        f"{name.text}, which has output arguments, within ?:, && or ||: use if"
                    )
                self._assign(argument)
            return Node("call", parts, function.type, name.text)
        if name.text not in RESULTS:
            raise self._error(f"{name.text}(), which is neither declared nor supported")
        result = RESULTS[name.text]
        if result == "widest":
            result = max((node.type for node in arguments), key=lambda type_: type_ in VECTORS)
        return Node("built-in", parts, result, name.text)


def _several(part: Part) -> bool:
    return isinstance(part, Node) and part.kind == "swizzle" and len(part.name) > 1


def _vector(scalar: str, count: int) -> str:
    return scalar if count == 1 else f"{_PREFIXES[scalar]}vec{count}"


def _product(sign: str, left: str, right: str) -> str:
    """Return the type of an arithmetic expression."""
    if sign == "*" and left in MATRICES and right in VECTORS:
        return _vector("float", MATRICES[left][1])
    if sign == "*" and left in VECTORS and right in MATRICES:
        return _vector("float", MATRICES[right][0])
    if sign == "*" and left in MATRICES and right in MATRICES:
        return f"mat{MATRICES[right][0]}x{MATRICES[left][1]}"
    is_wider = right in VECTORS or right in MATRICES or (left == "int" and right in SCALARS)
    return right if is_wider else left

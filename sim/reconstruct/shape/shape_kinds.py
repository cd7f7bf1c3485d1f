# SPDX-License-Identifier: MIT
"""The usual shapes of kinds of objects."""

from __future__ import annotations

from dataclasses import dataclass

FURNITURE = "furniture"
"""Shape of chairs, tables and shelves: boards and rods."""


@dataclass(frozen=True)
class KindShape:
    """Usual shape of a kind of object: ``box``, ``cylinder``, ``sphere``, ``furniture`` or ``inflated``, the last for
    all others.

    thickness: depth over width; of a box its smallest extent over its largest. None leaves it to the outline. back:
    ``symmetric`` or ``flat``.
    """

    shape: str
    thickness: float | None = None
    back: str = "symmetric"


def _rows(shape: str, thickness: float | None, names: str, back: str = "symmetric") -> dict[str, KindShape]:
    return {name.strip(): KindShape(shape, thickness, back) for name in names.split(",")}


KINDS: dict[str, KindShape] = {
    **_rows("box", 0.15, "book, notebook, novel, dictionary, magazine, laptop, tablet, dvd, chocolate bar, pizza box"),
    **_rows("box", 0.06, "phone, smartphone, card, envelope, letter, tile, board, cutting board, picture frame"),
    **_rows("box", 0.5, "box, carton, crate, parcel, package, brick, case, suitcase, chest, milk carton, tissue box"),
    **_rows("box", 1.0, "cube, dice, die, block, building block, rubik's cube"),
    **_rows("sphere", None, "sphere, ball, orange, apple, globe, marble, melon, watermelon, tomato, onion, grapefruit"),
    **_rows("sphere", None, "football, basketball, tennis ball, baseball, beach ball, bowling ball, snowball, bauble"),
    **_rows("cylinder", None, "cylinder, can, tin, cup, mug, glass, tumbler, beaker, bucket, barrel, drum, candle"),
    **_rows("cylinder", None, "jar, pot, pan, bowl, plate, dish, saucer, bottle, vase, jug, thermos, flask, lamp"),
    **_rows("cylinder", None, "cone, traffic cone, funnel, roll, cake, cheese wheel, puck, coin, chess piece, pawn"),
    **_rows("inflated", 0.9, "teddy, teddy bear, bear, plush, doll, toy, figure, figurine, statue, bust, duck"),
    **_rows("inflated", 0.8, "clay, dog, cat, animal, bunny, rabbit, horse, pumpkin, pear, bag, shoe, camera"),
    **_rows("inflated", 1.0, "banana, cucumber, carrot, pen, pencil, stick, sausage, rope, snake, egg, lemon, potato"),
    **_rows("furniture", None, "chair, armchair, stool, bar stool, bench, table, desk, coffee table, shelf, bookshelf"),
    **_rows("furniture", None, "bookcase, rack, shoe rack, side table, nightstand, easel, high chair, trestle"),
    **_rows("inflated", 0.6, "car, toy car, bread, loaf, pillow, cushion"),
    **_rows("inflated", 0.12, "leaf, feather, cookie, biscuit, coin purse, key, sticker, drawing, sheet", "flat"),
}
"""Names in the singular, lower case."""


def shape_of_kind(kind: str | None) -> KindShape | None:
    """Return the usual shape of ``kind``, None if unknown.

    Uses the longest run of words that is a name, the last one of equals: "a red toy car" is a toy car, "coffee mug" a
    mug.
    """
    if kind is None:
        return None
    words = [word.strip('.,;:()"') for word in kind.casefold().replace("_", " ").replace("-", " ").split()]
    for length in range(len(words), 0, -1):
        for start in range(len(words) - length, -1, -1):
            name = " ".join(words[start : start + length])
            for form in (name, name.removesuffix("s"), name.removesuffix("es")):
                if form in KINDS:
                    return KINDS[form]
    return None

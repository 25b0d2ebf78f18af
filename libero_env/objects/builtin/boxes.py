"""Flat packets that lie on a table: butter, cream cheese, pudding powder."""

from libero_env.objects.builtin.assemble import Look
from libero_env.objects.builtin.mesh import box
from libero_env.objects.builtin.paint import Canvas

# Parts of the picture: the large face (also below), the long sides, the short ends.
CELLS = {
    "top": (0.0, 0.0, 0.5, 1.0),
    "bottom": (0.0, 0.0, 0.5, 1.0),
    "left": (0.5, 0.8, 1.0, 1.0),
    "right": (0.5, 0.8, 1.0, 1.0),
    "front": (0.5, 0.5, 1.0, 0.75),
    "back": (0.5, 0.5, 1.0, 0.75),
}


def butter() -> Look:
    """Yellow packet, red ends, a pat of butter."""
    canvas = Canvas((250, 214, 70), (128, 128))
    canvas.rect(0.0, 0.0, 0.5, 0.30, (204, 40, 30))
    canvas.rect(0.0, 0.30, 0.5, 0.34, (255, 250, 235))
    canvas.text("BUTTER", (0.10, 0.38, 0.40, 0.97), (196, 34, 26), turn=90)
    canvas.polygon([(0.10, 0.08), (0.34, 0.08), (0.34, 0.18), (0.10, 0.18)], (255, 236, 130))
    canvas.polygon([(0.10, 0.18), (0.34, 0.18), (0.42, 0.24), (0.18, 0.24)], (255, 246, 180))
    canvas.polygon([(0.34, 0.08), (0.42, 0.14), (0.42, 0.24), (0.34, 0.18)], (232, 196, 80))
    canvas.rect(0.5, 0.5, 1.0, 0.75, (204, 40, 30))
    canvas.text("BUTTER", (0.55, 0.55, 0.95, 0.70), (255, 240, 170))
    canvas.text("BUTTER", (0.58, 0.83, 0.92, 0.97), (196, 34, 26))
    return Look(box((0.0384, 0.0197, 0.0088), (0, 0, 0), CELLS), canvas.png(), specular=0.15)


def cream_cheese() -> Look:
    """Pale silver-blue packet with a blue oval."""
    canvas = Canvas((206, 216, 236), (128, 128))
    for v in (0.04, 0.92):
        canvas.rect(0.0, v, 0.5, v + 0.04, (120, 146, 206))
    canvas.disc(0.25, 0.5, 0.20, 0.36, (250, 250, 252))
    canvas.disc(0.25, 0.5, 0.175, 0.325, (52, 76, 176))
    canvas.text("CREAM", (0.125, 0.28, 0.235, 0.72), (255, 255, 255), turn=90)
    canvas.text("CHEESE", (0.265, 0.28, 0.375, 0.72), (255, 255, 255), turn=90)
    canvas.disc(0.75, 0.625, 0.18, 0.10, (52, 76, 176))
    canvas.text("CREAM", (0.63, 0.585, 0.87, 0.665), (255, 255, 255))
    canvas.text("CREAM CHEESE", (0.54, 0.84, 0.96, 0.96), (52, 76, 176))
    return Look(box((0.0410, 0.0213, 0.0092), (0, 0, 0), CELLS), canvas.png(), specular=0.4)


def chocolate_pudding() -> Look:
    """Dark brown packet, a cup of pudding with cream, cream-coloured letters."""
    canvas = Canvas((78, 40, 22), (128, 128))
    canvas.rect(0.0, 0.94, 0.5, 1.0, (214, 52, 34))
    canvas.text("PUDDING", (0.05, 0.36, 0.22, 0.92), (252, 224, 168), turn=90)
    canvas.text("CHOCOLATE", (0.28, 0.36, 0.40, 0.92), (240, 150, 90), turn=90)
    canvas.disc(0.25, 0.17, 0.19, 0.14, (246, 240, 226))
    canvas.disc(0.25, 0.17, 0.16, 0.115, (120, 64, 34))
    canvas.disc(0.25, 0.18, 0.08, 0.06, (255, 252, 240))
    canvas.rect(0.5, 0.5, 1.0, 0.53, (214, 52, 34))
    canvas.text("PUDDING", (0.55, 0.57, 0.95, 0.71), (252, 224, 168))
    canvas.text("PUDDING", (0.56, 0.83, 0.94, 0.97), (252, 224, 168))
    return Look(box((0.0412, 0.0238, 0.0141), (0.0, 0, 0.0006), CELLS), canvas.png(), specular=0.2)


LOOKS = {"butter": butter, "chocolate_pudding": chocolate_pudding, "cream_cheese": cream_cheese}

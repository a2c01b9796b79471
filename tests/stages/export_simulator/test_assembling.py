"""The page is put together as it is meant, whatever the animal is called."""

from stages.export_simulator import page


def test_a_name_that_is_a_mark_stays_a_name():
    marks = "@@ASSETS@@ @@SCRIPT@@ @@NAME@@"
    text = page.page(contract={"name": marks}, assets={"room": page.Asset(b"room")})
    assert f"<h1>{marks}</h1>" in text
    assert text.count('id="asset-room"') == 1

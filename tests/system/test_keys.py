"""Keys on disk: the commands that make and list them."""

from gigabrain_zenoh.testing.processes import Home


async def test_keys_are_issued_and_listed_by_command(home: Home) -> None:
    folder = str(home.folder / "fleet")
    new = await home.run("keys", "new", "home", "--dir", folder)
    assert new.out.splitlines()[-1] == (
        f"next: gigabrain keys issue robot --host ADDRESS --dir {folder}"
    )
    issued = await home.run("keys", "issue", "viewer", "--days", "3", "--dir", folder)
    assert issued.out.startswith(f"{folder}/viewer: copy it to its host")
    listed = await home.run("keys", "list", "--dir", folder)
    assert listed.out.startswith("viewer               viewer of home  ")
    assert listed.out.endswith("in 3 days  SOON\n")
    (home.folder / "fleet" / "viewer" / "identity.key").chmod(0o644)
    assert await home.start("keys", "list", "--dir", folder).ended() == 1
    again = await home.run("keys", "new", "home", "--dir", folder)
    assert await again.ended() == 2
    assert "keys are never overwritten" in again.err

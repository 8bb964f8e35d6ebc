"""Attacks on the real commands, for `scripts/attack` and the slow tests.

    scripts/attack [--seconds S] [--seed N] [--only NAME …] [--round N]

`attacks` holds one attack a file. Each round of an attack has a new folder and a random generator
seeded with seed, attack and round. Round 0 plays the cases that once did harm, later rounds random
ones. Whatever the attack, these must hold:

* no event that a recorder acknowledged is missing from the log, the log has no event that was never
  sent, and none changes its offset (`oracle`);
* no traceback and no panic on the stderr of any command, and none dies of a signal that the attack
  did not send;
* a recorder, reader or server never takes more than 600 MB of memory (`attacked_command`);
* an honest question to the service is answered within two seconds (`honest_client`).
"""

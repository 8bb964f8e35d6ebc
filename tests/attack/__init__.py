"""An attacker of the real commands, for `scripts/attack` and the slow tests.

    python -m tests.attack [--seconds S] [--seed N] [--only NAME …] [--round N]

`attacks` holds one attack a file. Each round of an attack gets a fresh folder and a chance that
follows from seed, attack and round alone. Round 0 plays the cases that once did harm, later rounds
random ones. Whatever the attack, these must hold:

* no event that a recorder acknowledged is missing from the log, none stands there that nobody sent,
  and none changes its offset (`oracle`);
* no traceback and no panic on the stderr of any command, and none dies of a signal we did not send;
* a recorder, reader or server never takes more than 600 MB of memory (`victim`);
* an honest question to the service is answered within two seconds (`questioner`).
"""

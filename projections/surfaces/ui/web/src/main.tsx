import "./styles/base.css";
import "./styles/layout.css";
import "./styles/panels.css";
import { render } from "preact";
import { isSaved } from "./api/saved";
import { keepBench } from "./bench";
import { keepLive } from "./panels/Live";
import { keepWalls } from "./state/walls";
import { keepKnown, load } from "./state/loading";
import { keepPlaying, keepRested } from "./state/playing";
import { keepTheme } from "./state/theme";
import { keepAddress } from "./state/url";
import { App } from "./ui/App";
import { keepFaults } from "./ui/faults";
import { keepKeys } from "./ui/keyboard";

keepFaults();
keepTheme();
render(<App />, document.getElementById("app") as HTMLElement);
keepKeys();
keepPlaying();
keepRested();
keepBench();
void load().then(() => {
  keepAddress();
  keepKnown();
  keepWalls();
  if (!isSaved) keepLive();
});

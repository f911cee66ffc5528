// The buttons that make the face speak or silence it: microphone, file and sound.

import { element, setTextKey } from "./elements.js";
import { translate } from "./language.js";
import { Microphone } from "./microphone.js";

export class SpeechControls {
  microphone;
  // state and session of the microphone
  state = "off";
  session = null;
  #sound;
  #handlers;
  #isPaused = false; // while Learn my mouth is open
  #wasSoundWanted = false; // whether sound was on before the microphone or Learn my mouth muted it

  /**
   * @param {Sound} sound the session's sound
   * @param handlers { mouthProfile(), language(), lipModel(), level(rms), fileEnded(name), error({ code, text }): as
   *   of Microphone, fileStarted(), toast(text), session(name): the microphone's session, null when it ends }
   */
  constructor(sound, handlers) {
    this.#sound = sound;
    this.#handlers = handlers;
    this.microphone = new Microphone({
      ...handlers,
      state: (state) => this.#onState(state),
      session: (name) => this.#onSession(name),
    });
    element("microphone").onclick = () => {
      const isOn = this.microphone.isActive && !this.microphone.isFile;
      this.microphone.stop();
      if (!isOn) this.microphone.start();
    };
    element("open-file").onclick = () => {
      if (this.microphone.isFile) this.microphone.stop();
      else element("file").click();
    };
    element("file").onchange = ({ target }) => {
      if (target.files.length > 0) this.#speakFile(target.files[0]);
      target.value = ""; // so that the same file can be chosen again
    };
    document.ondragover = (event) => event.preventDefault();
    document.ondrop = (event) => {
      event.preventDefault();
      const { files } = event.dataTransfer;
      if (files.length === 0 || this.#isPaused) return;
      this.#speakFile(files[0]);
      if (files.length > 1) this.#handlers.toast(translate("severalFiles", { file: files[0].name }));
    };
    element("sound").onclick = () => {
      if (sound.state === "on") this.#turnSoundOff();
      else this.turnSoundOn();
    };
  }

  /** Restart the microphone, if it is on, in another session. */
  restart() {
    if (!this.microphone.isActive || this.microphone.isFile) return;
    this.microphone.stop();
    this.microphone.start();
  }

  /** Stop the microphone, mute the sound, and ignore dropped files while Learn my mouth is open. */
  pause() {
    this.#isPaused = true;
    this.microphone.stop();
    this.#mute();
  }

  /** Undo pause(). The microphone stays off. */
  resume() {
    this.#isPaused = false;
    this.#unmute();
  }

  #unmute() {
    if (this.#wasSoundWanted) this.turnSoundOn();
  }

  /** Turn sound on if the browser blocked it before the user's first click. */
  unblockSound() {
    if (this.#sound.state === "blocked") this.turnSoundOn();
  }

  /** Turn the session's sound on; show an error if it fails. */
  async turnSoundOn() {
    try {
      await this.#sound.turnOn();
    } catch (error) {
      const text = isSecureContext ? translate("soundFailed", { reason: error.message }) : translate("soundInsecure");
      this.#handlers.error({ code: "sound", text });
    }
  }

  /** Show the state of the sound on its button. */
  showSound() {
    const button = element("sound");
    const isBlocked = this.#sound.state === "blocked";
    button.setAttribute("aria-pressed", this.#sound.state === "on");
    button.classList.toggle("asks", isBlocked);
    setTextKey(button.querySelector("span"), isBlocked ? "turnOnSound" : "sound");
  }

  #speakFile(file) {
    this.unblockSound();
    this.#handlers.fileStarted();
    this.microphone.startFile(file);
  }

  /** Turn sound off for the user. It stays off when the microphone or the file ends. */
  #turnSoundOff() {
    this.#wasSoundWanted = false;
    this.#sound.turnOff();
  }

  #mute() {
    this.#wasSoundWanted = this.#sound.isWanted;
    this.#sound.turnOff();
  }

  #onState(state) {
    this.state = state;
    const isOn = state === "on" || state === "interrupted";
    const isBusy = state === "starting" || state === "interrupted";
    for (const id of ["microphone", "open-file"]) {
      const isSource = this.microphone.isFile === (id === "open-file");
      element(id).setAttribute("aria-pressed", isOn && isSource);
      element(id).setAttribute("aria-busy", isBusy && isSource);
    }
    if (state === "off" && this.session !== null) {
      this.session = null;
      this.#handlers.session(null);
      this.#unmute();
    }
  }

  #onSession(name) {
    // Hearing your own voice with a delay is distracting. A file stays audible.
    if (this.session === null && !this.microphone.isFile) this.#mute();
    else if (this.session === null) this.#wasSoundWanted = this.#sound.isWanted;
    this.session = name;
    this.#handlers.session(name);
  }
}

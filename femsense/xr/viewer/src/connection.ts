// The WebSocket of a stream, with automatic reconnection.

import { unpack, type Message } from "./messages";

export const NO_CONNECTION = "no connection";
const CONFIRMED = new Uint8Array(0); // an empty frame acknowledges the last one
const AGAIN_MS = [200, 500, 1000, 2000];

export class Connection {
  private socket: WebSocket | null = null;
  private attempt = 0;
  private away = NO_CONNECTION; // message while disconnected

  constructor(
    private readonly url: string,
    private readonly take: (messages: Message[]) => void,
    private readonly change: (away: string) => void,
  ) {
    this.open();
  }

  send(frame: Uint8Array<ArrayBuffer>): void {
    if (this.socket?.readyState === WebSocket.OPEN && this.socket.bufferedAmount < 8192) this.socket.send(frame);
  }

  private open(): void {
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("open", () => {
      this.attempt = 0;
      this.change("");
    });
    socket.addEventListener("message", (event) => {
      if (!(event.data instanceof ArrayBuffer)) return;
      this.take(unpack(event.data));
      if (socket.readyState === WebSocket.OPEN) socket.send(CONFIRMED);
    });
    socket.addEventListener("close", () => {
      this.change(this.away);
      void whyAway().then((why) => {
        this.away = why;
        if (this.socket?.readyState !== WebSocket.OPEN) this.change(why);
      });
      setTimeout(() => this.open(), AGAIN_MS[Math.min(this.attempt++, AGAIN_MS.length - 1)]);
    });
    this.socket = socket;
  }
}

/** Returns the reason of a missing connection, which a refused socket does not provide. */
async function whyAway(): Promise<string> {
  const answer = await fetch("stream.json", { cache: "no-store" }).catch(() => null);
  return answer?.status === 401 ? "password refused: load the page again" : NO_CONNECTION;
}

/** The address of the stream on the server of this page. */
export function streamUrl(): string {
  return new URL("ws", location.href.replace(/^http/, "ws").replace(/[?#].*$/, "")).href;
}

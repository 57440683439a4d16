// The rate of poses of a source.

const OVER_MS = 2000; // length of the counting window
export const COUNT_MS = 100; // interval between counts

/** Uses the sequence numbers of the poses: a busy page receives them late, incompletely and in bursts. */
export class Pace {
  private newest = { at: -Infinity, seq: 0 }; // arrival time [ms of the page], and sequence number
  private readonly counts: { at: number; seq: number }[] = [];

  /** Records a pose. */
  take(at: number, seq: number): void {
    if (seq < this.newest.seq) this.counts.length = 0; // the source restarted
    this.newest = { at, seq };
  }

  /** Counts; to be called every COUNT_MS. */
  count(now: number): void {
    if (this.newest.at > (this.counts[this.counts.length - 1]?.at ?? -Infinity)) this.counts.push(this.newest);
    while (this.counts.length && this.counts[0]!.at < now - OVER_MS) this.counts.shift();
  }

  /** Returns the median of the slopes between counts (Theil–Sen), which is robust to late counts; null if there are too few. */
  hz(): number | null {
    const { counts } = this;
    const span = counts.length ? counts[counts.length - 1]!.at - counts[0]!.at : 0;
    if (span < OVER_MS / 4) return null;
    const slopes = counts.flatMap((a, i) => counts.slice(i + 1).map((b) => (1000 * (b.seq - a.seq)) / (b.at - a.at)));
    return slopes.sort((a, b) => a - b)[slopes.length >> 1]!;
  }
}

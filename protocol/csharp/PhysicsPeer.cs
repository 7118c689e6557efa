// A physics process's life: attach to the session that an agent offers, answer its requests over a plant, leave.
//
// A console program calls Serve, which waits. A game loop calls TryAttach until it is true, then TryAnswer as often
// as it likes; neither of them ever waits for the agent.

using System;
using System.Diagnostics;
using System.Threading;

namespace TubeCosim
{
    public enum Turn
    {
        Idle, // the agent has asked for nothing
        Answered,
        Closed, // the agent has said goodbye, and the peer has left
    }

    public sealed class PhysicsPeer : IDisposable
    {
        private const int Polls = 50;
        private const long YieldingMs = 50, LookMs = 30;
        private const double NapMs = 1.0, LongestNapMs = 15.0;
        private const int LookAgainMs = 5;

        private readonly string rendezvous;
        private readonly IPlant plant;
        private readonly Opening opening;
        private readonly Stopwatch clock = Stopwatch.StartNew();
        private Segments segments; // while there is a session
        private PhysicsSession session;
        private long lookedAt;
        private bool hasLeft;

        // Throws ProtocolException where the rendezvous cannot be used on this system.
        public PhysicsPeer(string rendezvous, IPlant plant)
        {
            if (IntPtr.Size != 8 || !BitConverter.IsLittleEndian)
                throw new NotSupportedException("the protocol needs a 64-bit little-endian process");
            this.rendezvous = rendezvous;
            this.plant = plant;
            opening = new Opening(Rendezvous.Parse(rendezvous));
        }

        // Control steps integrated in this session.
        public long Steps
        {
            get { return session == null ? 0 : session.Steps; }
        }

        // What TryAttach found instead of a session, for messages.
        public string News
        {
            get { return opening.News; }
        }

        // Waits for a session, then answers its requests until the agent says goodbye. `stop` is asked now and then
        // and says why to leave, or null. Throws ProtocolException, or what the plant threw; the agent is told.
        public static void Serve(string rendezvous, IPlant plant, double attachTimeout, Func<string> stop)
        {
            using (PhysicsPeer peer = new PhysicsPeer(rendezvous, plant))
            {
                peer.Attach(attachTimeout, stop);
                peer.Guard(() => peer.AnswerAll(stop));
            }
        }

        // Looks once whether a session is on offer; if so, opens the plant and answers the handshake.
        public bool TryAttach()
        {
            if (hasLeft)
                throw new InvalidOperationException("this peer's session is over; make a new PhysicsPeer");
            if (segments != null)
                return true;
            segments = opening.TryClaim();
            if (segments == null)
                return false;
            Guard(() => session = new PhysicsSession(segments.Command, segments.Pose, plant));
            return true;
        }

        // Answers the agent's request if there is one. Throws ProtocolException, or what the plant threw; the agent
        // is told, and this peer has left by then.
        public Turn TryAnswer()
        {
            if (segments == null)
                throw new InvalidOperationException("expected TryAttach to be true before TryAnswer");
            Turn turn = Turn.Idle;
            Guard(() => turn = AnswerOne());
            return turn;
        }

        // Leaves for a reason of our own, and closes the plant; idempotent.
        public void Stop(string why)
        {
            if (segments != null)
                Handshake.SayFarewell(segments.Pose, Farewell.Stopped, why);
            Leave();
        }

        public void Dispose()
        {
            Stop("it was told to stop");
        }

        // Tells the agent of whatever ends the session, and leaves.
        private void Guard(Action action)
        {
            try
            {
                action();
            }
            catch (Exception error)
            {
                ProtocolException known = error as ProtocolException;
                Farewell reason = known == null ? Farewell.Failed : known.Farewell;
                string name = known == null ? error.GetType().Name + ": " : "";
                Handshake.SayFarewell(segments.Pose, reason, name + error.Message);
                Leave();
                throw;
            }
        }

        private void Leave()
        {
            if (hasLeft)
                return;
            hasLeft = true;
            if (segments != null)
                segments.Leave();
            segments = null;
            plant.Close();
        }

        private void Attach(double timeout, Func<string> stop)
        {
            while (!TryAttach())
            {
                string why = stop();
                if (why != null)
                    throw new PeerLost(why + " before there was a session");
                if (clock.Elapsed.TotalSeconds > timeout)
                    throw new PeerLost("no session at " + rendezvous + " within " + Format.Of(timeout)
                        + " s, found " + News + "; is the agent running?");
                Thread.Sleep(LookAgainMs);
            }
        }

        private void AnswerAll(Func<string> stop)
        {
            int polls = Polls;
            do
            {
                string why = stop();
                if (why == null && !HasRungWithin(polls))
                {
                    Thread.Yield();
                    // Where the answer is there after the first yield, polling only kept the agent from running.
                    polls = session.HasRung ? 1 : Polls;
                    why = WaitLong(stop);
                }
                if (why != null)
                    throw new ProtocolException(Farewell.Stopped, why);
            } while (session.Answer());
            Leave();
        }

        private bool HasRungWithin(int polls)
        {
            while (polls-- > 0)
                if (session.HasRung)
                    return true;
            return false;
        }

        // Waits for a request with an eye on the agent; returns why to stop instead, or null.
        private string WaitLong(Func<string> stop)
        {
            long began = clock.ElapsedMilliseconds;
            double nap = NapMs;
            string why = null;
            lookedAt = began;
            while (why == null && !session.HasRung)
            {
                if (clock.ElapsedMilliseconds - began < YieldingMs)
                {
                    Thread.Yield();
                }
                else
                {
                    Thread.Sleep((int)nap);
                    nap = Math.Min(1.2 * nap, LongestNapMs);
                }
                LookIfDue();
                why = stop();
            }
            return why;
        }

        private Turn AnswerOne()
        {
            if (!session.HasRung)
            {
                LookIfDue();
                return Turn.Idle;
            }
            if (session.Answer())
                return Turn.Answered;
            Leave();
            return Turn.Closed;
        }

        // Throws PeerLost where the agent has left or is dead, unless it rang before: that request goes first.
        private void LookIfDue()
        {
            long now = clock.ElapsedMilliseconds;
            if (now - lookedAt < LookMs)
                return;
            lookedAt = now;
            Offer agent = session.Offer;
            long farewell = segments.Command.Acquire(Layout.Command.Farewell);
            bool dead = Liveness.IsDead(agent.Pid, agent.StartTime);
            if ((farewell == 0 && !dead) || session.HasRung)
                return;
            string how = "its process is gone";
            if (farewell != 0)
                how = "it said farewell " + Format.Of(farewell) + ": "
                    + segments.Command.ReadText(Layout.Command.FarewellText, Layout.Command.FarewellTextSize);
            throw new PeerLost("lost agent (pid " + Format.Of(agent.Pid) + ") at step " + Format.Of(Steps) + ": "
                + how);
        }
    }
}

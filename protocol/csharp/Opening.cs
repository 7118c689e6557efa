// Finding the session that an agent offers, and claiming its physics side.

using System;
using System.Diagnostics;

namespace TubeCosim
{
    // Both segments of a session that this process has claimed.
    public sealed class Segments
    {
        public readonly Segment Command, Pose;

        public Segments(Segment command, Segment pose)
        {
            Command = command;
            Pose = pose;
        }

        // Unmaps; removes both names if the agent is dead, so that segments never outlive the run.
        public void Leave()
        {
            if (Opening.AgentIsDead(Command) && Command.LockToRemove(Opening.CreationGraceMs))
            {
                Pose.RemoveAndDispose(); // first: a segment that stands alone is a .cmd, which tells whose it was
                Command.RemoveAndDispose();
            }
            else
            {
                Command.Dispose();
                Pose.Dispose();
            }
        }
    }

    // Looks for a session, once each time it is asked, and remembers how long a header has been unfinished.
    public sealed class Opening
    {
        private const string CommandSuffix = ".cmd";
        private const string PoseSuffix = ".pose";
        private const string Unfinished = "a header that is not finished";
        private const int HeaderBytes = 2048;
        internal const long CreationGraceMs = 500;

        private readonly Rendezvous rendezvous;
        private readonly Stopwatch unfinished = new Stopwatch();

        // What was found instead of a session, for messages.
        public string News { get; private set; }

        public Opening(Rendezvous rendezvous)
        {
            this.rendezvous = rendezvous;
            News = "nothing of that name";
        }

        // Returns the segments of a session that is on offer, claimed, or null while there is none. Removes what a
        // dead agent left behind. Throws ProtocolException where another physics process serves or has served it.
        public Segments TryClaim()
        {
            Segment command = Segment.Open(rendezvous, CommandSuffix, false), pose = null;
            if (command == null)
            {
                LookForEmptySegment();
                return null;
            }
            try
            {
                // The agent makes `.pose` before its magic, and another session's may stand there before and after.
                bool finished = command.Size >= HeaderBytes && command.Acquire(Layout.Command.Magic) != 0;
                pose = Segment.Open(rendezvous, PoseSuffix, true);
                if (!IsOnOffer(command, pose) || !finished || !command.NameStands())
                    return null;
                Claim(pose);
                Segments segments = new Segments(command, pose);
                command = pose = null;
                return segments;
            }
            finally
            {
                if (command != null)
                    command.Dispose();
                if (pose != null)
                    pose.Dispose();
            }
        }

        public static bool AgentIsDead(Segment command)
        {
            return command.Acquire(Layout.Command.Magic) == Layout.CommandMagic
                && Liveness.IsDead(command.Read(Layout.Command.Pid), command.Read(Layout.Command.StartTime));
        }

        private bool IsOnOffer(Segment command, Segment pose)
        {
            bool whole = command.Size >= HeaderBytes, finished = whole && command.Acquire(Layout.Command.Magic) != 0;
            if (!whole || finished)
                unfinished.Reset();
            else
                unfinished.Start();
            if (!whole)
                News = "a file too short for a segment";
            else if (!finished)
                News = Unfinished;
            else if (AgentIsDead(command))
                News = "stale segments of a dead agent";
            else if (command.Read(Layout.Command.Magic) == Layout.CommandMagic
                && command.Acquire(Layout.Command.Farewell) != 0)
                News = "a session that its agent has left";
            else if (pose == null)
                News = "a command segment without its pose segment";
            else
                return true; // also with a foreign magic, which the handshake names
            bool abandoned = unfinished.ElapsedMilliseconds >= CreationGraceMs || (finished && AgentIsDead(command));
            if (abandoned && command.LockToRemove(0)) // an agent that is writing its header, or replacing these, holds it
            {
                if (pose != null)
                    pose.RemoveAndDispose();
                command.RemoveAndDispose();
            }
            return false;
        }

        // A segment without a size is one that its agent has just made, or died over.
        private void LookForEmptySegment()
        {
            bool empty = Segment.IsEmpty(rendezvous, CommandSuffix);
            News = empty ? Unfinished : "nothing of that name";
            if (!empty)
                unfinished.Reset();
            else if (unfinished.ElapsedMilliseconds < CreationGraceMs)
                unfinished.Start();
            else
                Segment.RemoveEmpty(rendezvous, CommandSuffix);
        }

        private void Claim(Segment pose)
        {
            if (pose.Size < HeaderBytes)
                throw new HandshakeException("size of the pose segment", "at least 2048 bytes",
                    Format.Of(pose.Size));
            string serving = rendezvous + ": another physics process (pid " + Format.Of(pose.Read(Layout.Pose.Pid));
            if (!pose.Lock())
                throw new ProtocolException(Farewell.None, serving + ") serves this session");
            if (pose.Acquire(Layout.Pose.Magic) != 0 || pose.Acquire(Layout.Pose.Farewell) != 0)
                throw new ProtocolException(Farewell.None, serving + ") has served this session already");
        }
    }
}

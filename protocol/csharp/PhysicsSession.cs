// The physics side's half of a session: it answers requests over a plant, and neither waits nor removes anything.

using System;
using System.Collections.Generic;
using System.Diagnostics;

namespace TubeCosim
{
    public sealed class PhysicsSession
    {
        private readonly Segment command, pose;
        private readonly IPlant plant;
        private readonly double speedMax;
        private readonly HashSet<int> tubes = new HashSet<int>();
        private long number; // of the last request that was answered

        // Private copies of what is on the wire: a plant never sees words that may change under it.
        private readonly double[] commandRows, poseRows;
        private double[] resetRows; // made by the first reset
        private readonly LaneCommand[] commands;
        private readonly LanePose[] poses;
        private readonly bool[] wasReset;
        private readonly int[] laneTubes;
        private bool allWereReset;

        // What the agent asks of the session.
        public readonly Offer Offer;

        // Control steps integrated in this session.
        public long Steps { get; private set; }

        // Checks the agent's header, opens the plant, and publishes our header. Throws HandshakeException.
        public PhysicsSession(Segment command, Segment pose, IPlant plant)
        {
            this.command = command;
            this.pose = pose;
            this.plant = plant;
            Offer = new Offer(command, pose);
            int lanes = Offer.Lanes;
            commandRows = new double[lanes * Rows.CommandWords];
            poseRows = new double[lanes * Rows.PoseWords];
            commands = new LaneCommand[lanes];
            poses = new LanePose[lanes];
            wasReset = new bool[lanes];
            laneTubes = new int[lanes];
            PlantDescription description = plant.Describe();
            speedMax = description.SpeedMax;
            plant.Open(lanes, Offer.Dt, Offer.PhysicsDt, Offer.InnerSteps);
            Handshake.Answer(command, pose, Offer, description);
        }

        // Whether the agent has published a request.
        public bool HasRung
        {
            get { return command.Acquire(Layout.Command.Doorbell) != number; }
        }

        // Carries out the request that HasRung told of, publishes the reply, and says whether more may come. Throws
        // PeerViolation, or what the plant threw.
        public bool Answer()
        {
            long due = number + 1, rung = command.Read(Layout.Command.Doorbell);
            if (rung != due)
                throw new PeerViolation("rang the doorbell with " + Format.Of(rung) + " where " + Format.Of(due)
                    + " was due");
            Op op = (Op)command.Read(Layout.Command.Op);
            CopyRows(op);
            CheckFrame(op, due);
            Refusal refusal = null;
            long engineTicks = 0;
            try
            {
                engineTicks = CarryOut(op);
            }
            catch (Refusal refused)
            {
                refusal = refused;
            }
            Publish(due, refusal, (long)(engineTicks * (1e9 / Stopwatch.Frequency)));
            return op != Op.Goodbye;
        }

        private void CopyRows(Op op)
        {
            if (op == Op.Step)
            {
                command.Read(Layout.Command.Commands, commandRows);
            }
            else if (op == Op.Reset)
            {
                resetRows = resetRows ?? new double[Offer.Lanes * Rows.ResetWords];
                command.Read(Layout.Command.Commands + Offer.Lanes * Layout.CommandStride, resetRows);
            }
        }

        private void CheckFrame(Op op, long due)
        {
            long begin = command.Read(Layout.Command.Begin), end = command.Read(Layout.Command.End);
            if (begin != due || end != due)
                throw new PeerViolation("published a torn request: begin " + Format.Of(begin) + ", end "
                    + Format.Of(end) + " where " + Format.Of(due) + " was due");
            if (op < Op.Step || op > Op.Goodbye)
                throw new PeerViolation("asked for op " + Format.Of((long)op) + ", which version "
                    + Format.Of(Layout.VersionMajor) + " does not know");
            long step = command.Read(Layout.Command.Step), dueStep = op == Op.Step ? Steps + 1 : Steps;
            if (step != dueStep)
                throw new PeerViolation((step < dueStep ? "repeated" : "skipped") + " a step: asked for step "
                    + Format.Of(step) + " where " + Format.Of(dueStep) + " was due");
        }

        // Checks the payload, then does what is asked; returns how long the plant worked, in ticks of Stopwatch.
        private long CarryOut(Op op)
        {
            switch (op)
            {
                case Op.Step:
                    return Step();
                case Op.Reset:
                    return Reset();
                case Op.RegisterTube:
                    return RegisterTube();
                case Op.ReleaseTube:
                    return ReleaseTube();
                default:
                    return 0; // a goodbye asks for nothing but its reply
            }
        }

        private long Step()
        {
            if (!allWereReset)
                throw new Refusal("step", "a lane that was reset", "a lane never reset",
                    Array.IndexOf(wasReset, false), RefusalCode.NotReset);
            Validation.CheckCommands(commandRows, Offer.Lanes, speedMax);
            for (int lane = 0; lane < commands.Length; lane++)
            {
                Rows.ReadCommand(commandRows, lane, ref commands[lane]);
                commands[lane].Step = Rows.ReadStep(poseRows, lane) + 1;
            }
            long began = Stopwatch.GetTimestamp();
            plant.Step(commands, poses);
            long ticks = Stopwatch.GetTimestamp() - began;
            for (int lane = 0; lane < commands.Length; lane++)
                Rows.WritePose(poseRows, lane, poses[lane], commands[lane].Step, Offer.Dt);
            Steps++;
            return ticks;
        }

        private long Reset()
        {
            Validation.CheckResets(resetRows, Offer.Lanes, tubes);
            List<LaneReset> selected = new List<LaneReset>();
            for (int lane = 0; lane < Offer.Lanes; lane++)
                if (Rows.Integer(resetRows, lane * Rows.ResetWords, Layout.ResetRow.Selected) == 1)
                    selected.Add(Rows.ReadReset(resetRows, lane));
            long began = Stopwatch.GetTimestamp();
            plant.Reset(selected.ToArray(), poses);
            long ticks = Stopwatch.GetTimestamp() - began;
            foreach (LaneReset reset in selected)
            {
                poses[reset.Lane].ContactSteps = 0;
                Rows.WritePose(poseRows, reset.Lane, poses[reset.Lane], 0, Offer.Dt);
                laneTubes[reset.Lane] = reset.Tube;
                wasReset[reset.Lane] = true;
            }
            allWereReset = Array.IndexOf(wasReset, false) < 0;
            return ticks;
        }

        private long RegisterTube()
        {
            int index = Validation.TubeIndex(command, Offer.TubeSlots);
            TubeReference tube = Validation.Tube(command);
            if (tubes.Contains(index))
                throw new Refusal("tube_index", "a free slot", Format.Of(index) + ", taken", -1,
                    RefusalCode.TubeSlot);
            long began = Stopwatch.GetTimestamp();
            plant.RegisterTube(index, tube);
            tubes.Add(index);
            return Stopwatch.GetTimestamp() - began;
        }

        private long ReleaseTube()
        {
            int index = Validation.TubeIndex(command, Offer.TubeSlots);
            if (!tubes.Contains(index))
                throw new Refusal("tube_index", "a registered tube", Format.Of(index), -1, RefusalCode.UnknownTube);
            for (int lane = 0; lane < laneTubes.Length; lane++)
                if (wasReset[lane] && laneTubes[lane] == index)
                    throw new Refusal("tube_index", "a tube that no lane flies in", Format.Of(index), lane,
                        RefusalCode.TubeInUse);
            long began = Stopwatch.GetTimestamp();
            plant.ReleaseTube(index);
            tubes.Remove(index);
            return Stopwatch.GetTimestamp() - began;
        }

        private void Publish(long due, Refusal refusal, long engineNs)
        {
            if (command.Read(Layout.Command.Doorbell) != due || command.Read(Layout.Command.Begin) != due)
                throw new PeerViolation("wrote an early request before request " + Format.Of(due) + " was answered");
            pose.Write(Layout.Pose.Begin, due);
            pose.Fence(); // for observers: the first word before the payload
            if (refusal == null)
                pose.Write(Layout.Pose.Poses, poseRows);
            else
                WriteRefusal(refusal);
            pose.Write(Layout.Pose.Status, (long)(refusal == null ? Status.Done : Status.Refused));
            pose.Write(Layout.Pose.Step, Steps);
            pose.Write(Layout.Pose.EngineNs, engineNs);
            pose.Release(Layout.Pose.End, due);
            pose.Release(Layout.Pose.Doorbell, due);
            number = due;
        }

        private void WriteRefusal(Refusal refusal)
        {
            for (int lane = 0; lane < poses.Length; lane++) // a plant that refuses half-way may have changed some
                poses[lane] = Rows.ReadPose(poseRows, lane);
            pose.Write(Layout.Pose.RefusalCode, (long)refusal.Code);
            pose.Write(Layout.Pose.RefusalLane, (long)refusal.Lane);
            pose.WriteText(Layout.Pose.RefusalField, Layout.Pose.RefusalFieldSize, refusal.Field);
            pose.WriteText(Layout.Pose.RefusalExpected, Layout.Pose.RefusalExpectedSize, refusal.Expected);
            pose.WriteText(Layout.Pose.RefusalFound, Layout.Pose.RefusalFoundSize, refusal.Found);
        }
    }
}

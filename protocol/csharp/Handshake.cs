// The two headers and our farewell: what the agent asks, and what we answer.

using System;

namespace TubeCosim
{
    // The agent's header, checked.
    public sealed class Offer
    {
        public readonly int Lanes, InnerSteps, TubeSlots;
        public readonly double Dt, PhysicsDt;
        public readonly long Pid, StartTime;

        // Throws HandshakeException at the first field that is not as expected.
        public Offer(Segment command, Segment pose)
        {
            Demand("magic of the command segment", command.Read(Layout.Command.Magic) == Layout.CommandMagic,
                "TUBE.CMD", command.ReadText(Layout.Command.Magic, 8));
            Word(command, "version_major", Layout.Command.VersionMajor, Layout.VersionMajor, Layout.VersionMajor);
            Lanes = (int)Word(command, "lanes", Layout.Command.Lanes, 1, Layout.LanesMax);
            Dt = Time(command, "dt", Layout.Command.Dt);
            PhysicsDt = Time(command, "physics_dt", Layout.Command.PhysicsDt);
            InnerSteps = (int)Word(command, "inner_steps", Layout.Command.InnerSteps, 1, Layout.InnerStepsMax);
            Demand("inner_steps", Math.Abs(InnerSteps * PhysicsDt - Dt) <= 1e-9 * Dt,
                "dt / physics_dt = " + Format.Of(Dt / PhysicsDt), Format.Of(InnerSteps));
            TubeSlots = (int)Word(command, "tube_slots", Layout.Command.TubeSlots, 1, Layout.TubeSlotsMax);
            Exactly(command, "command_stride", Layout.Command.CommandStride, Layout.CommandStride);
            Exactly(command, "pose_stride", Layout.Command.PoseStride, Layout.PoseStride);
            Exactly(command, "reset_stride", Layout.Command.ResetStride, Layout.ResetStride);
            long size = Layout.Command.Commands + (long)Lanes * (Layout.CommandStride + Layout.ResetStride);
            Exactly(command, "segment_bytes", Layout.Command.SegmentBytes, size);
            Demand("size of the command segment", command.Size >= size, Format.Of(size), Format.Of(command.Size));
            long poseSize = PoseBytes;
            Demand("size of the pose segment", pose.Size >= poseSize, Format.Of(poseSize), Format.Of(pose.Size));
            Pid = command.Read(Layout.Command.Pid);
            StartTime = command.Read(Layout.Command.StartTime);
        }

        public long PoseBytes
        {
            get { return Layout.Pose.Poses + (long)Lanes * Layout.PoseStride; }
        }

        private static void Exactly(Segment command, string field, int offset, long expected)
        {
            Word(command, field, offset, expected, expected);
        }

        private static long Word(Segment command, string field, int offset, long lowest, long highest)
        {
            long value = command.Read(offset);
            string expected = Format.Of(lowest) + (lowest == highest ? "" : " to " + Format.Of(highest));
            Demand(field, value >= lowest && value <= highest, expected, Format.Of(value));
            return value;
        }

        private static double Time(Segment command, string field, int offset)
        {
            double value = command.ReadDouble(offset);
            Demand(field, value > 0.0 && Validation.IsFinite(value), "a time > 0 s", Format.Of(value));
            return value;
        }

        private static void Demand(string field, bool holds, string expected, string found)
        {
            if (!holds)
                throw new HandshakeException(field, expected, found);
        }
    }

    public static class Handshake
    {
        // Writes our header, which echoes the offer, its magic last.
        public static void Answer(Segment command, Segment pose, Offer offer, PlantDescription plant)
        {
            long pid, startTime;
            Liveness.Self(out pid, out startTime);
            pose.Write(Layout.Pose.Pid, pid); // first, so that a header cut short still says whose it was
            pose.Write(Layout.Pose.StartTime, startTime);
            pose.Write(Layout.Pose.VersionMajor, (long)Layout.VersionMajor);
            pose.Write(Layout.Pose.VersionMinor, (long)Layout.VersionMinor);
            pose.Write(Layout.Pose.SegmentBytes, offer.PoseBytes);
            pose.WriteBytes(Layout.Pose.Session,
                command.ReadBytes(Layout.Command.Session, Layout.Command.SessionSize));
            for (int offset = Layout.Command.Lanes; offset <= Layout.Command.ResetStride; offset += 8)
                pose.Write(offset, command.Read(offset));
            pose.Write(Layout.Pose.SpeedMax, plant.SpeedMax);
            pose.Write(Layout.Pose.Walls, plant.Walls ? 1L : 0L);
            double[] defaults = new double[Layout.ParameterSlots];
            Array.Copy(plant.Defaults, defaults, Layout.Parameters.Length);
            pose.Write(Layout.Pose.Defaults, defaults);
            pose.WriteText(Layout.Pose.PlantName, Layout.Pose.PlantNameSize, plant.Name);
            pose.WriteText(Layout.Pose.PlantVersion, Layout.Pose.PlantVersionSize, plant.Version);
            pose.WriteText(Layout.Pose.PlantEngine, Layout.Pose.PlantEngineSize, plant.Engine);
            pose.Release(Layout.Pose.Magic, Layout.PoseMagic);
        }

        // Says in our own segment why we leave: the text, then the word, which never changes again.
        public static void SayFarewell(Segment pose, Farewell reason, string text)
        {
            if (pose.Read(Layout.Pose.Farewell) != (long)Farewell.None)
                return;
            pose.WriteText(Layout.Pose.FarewellText, Layout.Pose.FarewellTextSize, text);
            pose.Release(Layout.Pose.Farewell, (long)reason);
        }
    }
}

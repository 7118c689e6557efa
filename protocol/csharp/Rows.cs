// Rows of the wire as words, and as the structs that a plant works on. The words are held as doubles; the integers
// among them are read and written by their bits.

using System;

namespace TubeCosim
{
    public static class Rows
    {
        public const int CommandWords = Layout.CommandStride / 8;
        public const int PoseWords = Layout.PoseStride / 8;
        public const int ResetWords = Layout.ResetStride / 8;

        // The integer at a byte offset of the row that begins at word `row`.
        public static long Integer(double[] rows, int row, int offset)
        {
            return BitConverter.DoubleToInt64Bits(rows[row + offset / 8]);
        }

        public static void ReadCommand(double[] rows, int lane, ref LaneCommand command)
        {
            int row = lane * CommandWords;
            command.Direction = Vector(rows, row + Layout.CommandRow.Direction / 8);
            command.Speed = rows[row + Layout.CommandRow.Speed / 8];
            command.Compensation = rows[row + Layout.CommandRow.Compensation / 8];
        }

        public static LaneReset ReadReset(double[] rows, int lane)
        {
            int row = lane * ResetWords;
            double[] parameters = new double[Layout.ParameterSlots];
            Array.Copy(rows, row + Layout.ResetRow.Parameters / 8, parameters, 0, parameters.Length);
            return new LaneReset
            {
                Lane = lane,
                Pose = State(rows, row),
                Tube = (int)Integer(rows, row, Layout.ResetRow.Tube),
                Seed = (ulong)Integer(rows, row, Layout.ResetRow.Seed),
                Parameters = parameters,
            };
        }

        public static LanePose ReadPose(double[] rows, int lane)
        {
            int row = lane * PoseWords;
            LanePose pose = State(rows, row);
            pose.ContactSteps = (int)Integer(rows, row, Layout.PoseRow.ContactSteps);
            return pose;
        }

        public static long ReadStep(double[] rows, int lane)
        {
            return Integer(rows, lane * PoseWords, Layout.PoseRow.Step);
        }

        // Throws where the state is no longer finite, which is never a reply.
        public static void WritePose(double[] rows, int lane, LanePose pose, long step, double dt)
        {
            int row = lane * PoseWords;
            SetVector(rows, row + Layout.PoseRow.Position / 8, pose.Position);
            SetRotation(rows, row + Layout.PoseRow.Quaternion / 8, pose.Rotation);
            SetVector(rows, row + Layout.PoseRow.LinearVelocity / 8, pose.LinearVelocity);
            SetVector(rows, row + Layout.PoseRow.AngularVelocity / 8, pose.AngularVelocity);
            rows[row + Layout.PoseRow.SimTime / 8] = step * dt;
            rows[row + Layout.PoseRow.ContactSteps / 8] = BitConverter.Int64BitsToDouble(pose.ContactSteps);
            rows[row + Layout.PoseRow.Step / 8] = BitConverter.Int64BitsToDouble(step);
            for (int word = row; word < row + Layout.PoseRow.SimTime / 8; word++)
                if (!Validation.IsFinite(rows[word]))
                    throw new ArithmeticException("the state of lane " + Format.Of(lane)
                        + " is no longer finite after its step " + Format.Of(step));
        }

        // Position, rotation and velocities, which begin reset rows and pose rows alike.
        private static LanePose State(double[] rows, int row)
        {
            int rotation = row + Layout.ResetRow.Quaternion / 8;
            return new LanePose
            {
                Position = Vector(rows, row + Layout.ResetRow.Position / 8),
                Rotation = new Quaterniond(rows[rotation], rows[rotation + 1], rows[rotation + 2],
                    rows[rotation + 3]),
                LinearVelocity = Vector(rows, row + Layout.ResetRow.LinearVelocity / 8),
                AngularVelocity = Vector(rows, row + Layout.ResetRow.AngularVelocity / 8),
            };
        }

        private static Vector3d Vector(double[] rows, int word)
        {
            return new Vector3d(rows[word], rows[word + 1], rows[word + 2]);
        }

        private static void SetVector(double[] rows, int word, Vector3d value)
        {
            rows[word] = value.X;
            rows[word + 1] = value.Y;
            rows[word + 2] = value.Z;
        }

        private static void SetRotation(double[] rows, int word, Quaterniond value)
        {
            rows[word] = value.X;
            rows[word + 1] = value.Y;
            rows[word + 2] = value.Z;
            rows[word + 3] = value.W;
        }
    }
}

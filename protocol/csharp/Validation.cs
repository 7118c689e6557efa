// What is checked of a request before anything is integrated; the first fault found is thrown as a Refusal.

using System;
using System.Collections.Generic;
using System.Text;

namespace TubeCosim
{
    public static class Validation
    {
        private const double UnitTolerance = Layout.UnitTolerance;

        public static bool IsFinite(double value)
        {
            return value - value == 0.0; // of infinities and NaN it is NaN
        }

        public static void CheckCommands(double[] rows, int lanes, double speedMax)
        {
            for (int lane = 0; lane < lanes; lane++)
            {
                int row = lane * Rows.CommandWords;
                CheckUnit(rows, row + Layout.CommandRow.Direction / 8, 3, "direction", lane);
                CheckRange(rows[row + Layout.CommandRow.Speed / 8], speedMax, "speed", lane);
                CheckRange(rows[row + Layout.CommandRow.Compensation / 8], Layout.CompensationMax, "compensation",
                    lane);
                for (int word = Layout.CommandRow.Reserved; word < Layout.CommandStride; word += 8)
                    CheckReserved(Rows.Integer(rows, row, word), "reserved command words", lane);
            }
        }

        // Checks the selected rows; `tubes` are the registered indices.
        public static void CheckResets(double[] rows, int lanes, ICollection<int> tubes)
        {
            for (int lane = 0; lane < lanes; lane++)
            {
                int row = lane * Rows.ResetWords;
                long selected = Rows.Integer(rows, row, Layout.ResetRow.Selected);
                if (selected != 0 && selected != 1)
                    throw new Refusal("selected", "0 or 1", Format.Of(selected), lane, RefusalCode.OutOfRange);
                if (selected == 1)
                    CheckReset(rows, row, lane, tubes);
            }
        }

        private static void CheckReset(double[] rows, int row, int lane, ICollection<int> tubes)
        {
            CheckFinite(rows, row + Layout.ResetRow.Position / 8, 3, "position", lane);
            CheckFinite(rows, row + Layout.ResetRow.Quaternion / 8, 4, "quaternion", lane);
            CheckFinite(rows, row + Layout.ResetRow.LinearVelocity / 8, 3, "linear_velocity", lane);
            CheckFinite(rows, row + Layout.ResetRow.AngularVelocity / 8, 3, "angular_velocity", lane);
            long tube = Rows.Integer(rows, row, Layout.ResetRow.Tube);
            if (tube != Layout.NoTube && (tube != (int)tube || !tubes.Contains((int)tube)))
                throw new Refusal("tube", "a registered tube's index, or -1", Format.Of(tube), lane,
                    RefusalCode.UnknownTube);
            CheckUnit(rows, row + Layout.ResetRow.Quaternion / 8, 4, "quaternion", lane);
            int parameters = row + Layout.ResetRow.Parameters / 8;
            for (int i = 0; i < Layout.Parameters.Length; i++)
                CheckParameter(Layout.Parameters[i], rows[parameters + i], lane);
            for (int i = Layout.Parameters.Length; i < Layout.ParameterSlots; i++)
                CheckReserved(Rows.Integer(rows, parameters, 8 * i), "reserved parameter words", lane);
        }

        private static void CheckParameter(Parameter parameter, double value, int lane)
        {
            if (!IsFinite(value))
                throw NotFinite(parameter.Name, value, lane);
            bool whole = !parameter.Whole || value == Math.Floor(value);
            if (!(whole && value >= parameter.Lowest && value <= parameter.Highest))
                throw new Refusal(parameter.Name, parameter.Range, Format.Of(value), lane, RefusalCode.OutOfRange);
        }

        private static void CheckFinite(double[] rows, int first, int count, string field, int lane)
        {
            for (int i = first; i < first + count; i++)
                if (!IsFinite(rows[i]))
                    throw NotFinite(field, rows[i], lane);
        }

        private static void CheckUnit(double[] rows, int first, int count, string field, int lane)
        {
            double squared = 0.0;
            for (int i = first; i < first + count; i++)
                squared += rows[i] * rows[i];
            if (Math.Abs(squared - 1.0) <= UnitTolerance)
                return; // NaN and infinity fail every comparison
            CheckFinite(rows, first, count, field, lane);
            throw new Refusal(field, "squared length 1 within " + Format.Of(UnitTolerance),
                "squared length " + Format.Of(squared), lane, RefusalCode.NotUnit);
        }

        private static void CheckRange(double value, double highest, string field, int lane)
        {
            if (value >= 0.0 && value <= highest)
                return;
            if (!IsFinite(value))
                throw NotFinite(field, value, lane);
            throw new Refusal(field, "0 to " + Format.Of(highest), Format.Of(value), lane, RefusalCode.OutOfRange);
        }

        private static void CheckReserved(long bits, string field, int lane)
        {
            if (bits != 0)
                throw new Refusal(field, "zero", "the integer " + Format.Of(bits), lane, RefusalCode.Reserved);
        }

        private static Refusal NotFinite(string field, double value, int lane)
        {
            return new Refusal(field, "a finite number", Format.Of(value), lane, RefusalCode.NotFinite);
        }

        // The index of a registration or a release.
        public static int TubeIndex(Segment command, long slots)
        {
            long index = command.Read(Layout.Command.TubeIndex);
            if (index < 0 || index >= slots)
                throw new Refusal("tube_index", "0 to " + Format.Of(slots - 1), Format.Of(index), -1,
                    RefusalCode.TubeSlot);
            return (int)index;
        }

        // The other words of a registration.
        public static TubeReference Tube(Segment command)
        {
            long axes = command.Read(Layout.Command.TubeAxes);
            double scale = command.ReadDouble(Layout.Command.TubeScale);
            long size = command.Read(Layout.Command.TubePathBytes);
            if (axes != Layout.ZUp && axes != Layout.YUp)
                throw Malformed("tube_axes", "0 (Z up) or 1 (Y up)", Format.Of(axes));
            if (!(scale > 0.0 && IsFinite(scale)))
                throw new Refusal("tube_scale", "a factor > 0", Format.Of(scale), -1, RefusalCode.OutOfRange);
            if (size < 1 || size > Layout.Command.TubePathSize)
                throw Malformed("tube_path_bytes", "1 to " + Format.Of(Layout.Command.TubePathSize),
                    Format.Of(size));
            return new TubeReference
            {
                Path = PathText(command.ReadBytes(Layout.Command.TubePath, (int)size)),
                YUp = axes == Layout.YUp,
                Scale = scale,
                Sha256 = command.ReadBytes(Layout.Command.TubeSha256, Layout.Command.TubeSha256Size),
            };
        }

        private static string PathText(byte[] bytes)
        {
            string path;
            try
            {
                path = new UTF8Encoding(false, true).GetString(bytes);
            }
            catch (ArgumentException)
            {
                throw Malformed("tube_path", "UTF-8", BitConverter.ToString(bytes));
            }
            if (path.IndexOf('\0') >= 0)
                throw Malformed("tube_path", "a path without zero bytes", path.Replace('\0', '?'));
            return path;
        }

        private static Refusal Malformed(string field, string expected, string found)
        {
            return new Refusal(field, expected, found, -1, RefusalCode.Malformed);
        }
    }
}
